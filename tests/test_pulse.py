from psiu_broker.pulse import STALE_S, STOOD_STILL_S, Pulse


def test_ticks_that_are_a_little_late_are_no_pause() -> None:
    pulse = Pulse(10)
    assert [pulse.beat(now) for now in (10.1, 10.2, 10.2 + STOOD_STILL_S)] == [0, 0, 0]
    assert not pulse.stale(11.2)


def test_what_comes_while_the_loop_does_not_go_round_is_stale_before_the_next_beat_tells() -> None:
    pulse = Pulse(10)
    assert not pulse.stale(10 + STOOD_STILL_S)
    assert pulse.stale(10.1 + STOOD_STILL_S)
    assert pulse.since_s(12) == 2


def test_what_waited_while_the_broker_stood_still_may_come_for_a_moment_more() -> None:
    pulse = Pulse(10)
    assert pulse.beat(15) == 5
    assert pulse.stale(15 + 0.9 * STALE_S)
    assert not pulse.stale(15 + STALE_S)
