from psiu_broker.frame import Address, Frame, Way
from psiu_broker.routing.askers import ROBOTS_KEPT, Askers
from psiu_broker.routing.holding import Holding

RADIO = Way("radio")
PC, MNERIM = Address.named("PC"), Address.named("MNERIM")


def frame(destination: str, payload: bytes = b"parafrente 1") -> Frame:
    return Frame(PC, Address.named(destination), "parafrente", payload, "psiu-ascii")


def test_frames_for_an_unknown_robot_leave_in_order_when_it_is_heard() -> None:
    holding = Holding(0.5)
    assert holding.add(frame("MNERIM", b"1"), RADIO, 0.0)
    assert holding.add(frame("MNERIM", b"2"), RADIO, 0.1)
    assert holding.add(frame("OTHER"), RADIO, 0.1)
    assert [held.frame.payload for held in holding.release(MNERIM)] == [b"1", b"2"]
    assert holding.release(MNERIM) == []
    assert [held.arrived.link for held in holding] == ["radio"] * 1


def test_a_frame_is_held_only_briefly() -> None:
    holding = Holding(0.5)
    holding.add(frame("MNERIM"), RADIO, 0.0)
    holding.add(frame("MNERIM"), RADIO, 0.3)
    assert len(holding.expire(0.5)) == 1
    assert [held.arrived.link for held in holding] == ["radio"] * 1
    assert len(holding.expire(0.8)) == 1
    assert [held.arrived.link for held in holding] == ["radio"] * 0


def test_a_frame_that_was_old_when_it_came_goes_before_those_that_came_before_it() -> None:
    holding = Holding(0.5)
    holding.add(frame("MNERIM", b"new"), RADIO, 0.4)
    holding.add(frame("MNERIM", b"old"), Way("@mesh", "other"), 0.1)
    assert [held.frame.payload for held in holding.expire(0.6)] == [b"old"]
    assert [held.frame.payload for held in holding.expire(0.9)] == [b"new"]


def test_a_robot_is_asked_for_again_while_frames_for_it_keep_coming() -> None:
    holding = Holding(0.5)
    asked = []
    for tenth in range(20):
        now = tenth / 10
        holding.expire(now)
        holding.add(frame("MNERIM"), RADIO, now)
        if holding.is_due(MNERIM, now):
            holding.asked(MNERIM, now)
            asked.append(now)
    assert asked == [0.0, 0.5, 1.0, 1.5]


def test_a_robot_that_was_heard_and_lost_again_is_asked_for_at_once() -> None:
    holding = Holding(0.5)
    holding.add(frame("MNERIM"), RADIO, 0.0)
    holding.asked(MNERIM, 0.0)
    holding.release(MNERIM)
    assert holding.is_due(MNERIM, 0.1)


def test_a_flood_of_unknown_names_is_neither_kept_nor_asked_for() -> None:
    holding = Holding(0.5, capacity=100, asks=8)
    kept = [holding.add(frame(f"R{number}"), RADIO, 0.0) for number in range(50)]
    assert sum(kept) == 8
    kept = [holding.add(frame("R0"), RADIO, 0.0) for _ in range(200)]
    assert [held.arrived.link for held in holding] == ["radio"] * 100
    assert len(holding.expire(1.0)) == 100


def test_an_answer_without_destination_is_for_the_last_who_asked_and_only_for_a_while() -> None:
    askers = Askers(window_s=2.0)
    arm = Address.numbered(0x12)
    assert askers.of(arm, 0.0) is None
    askers.note(arm, Address.numbered(1), 0.0)
    askers.note(arm, Address.numbered(2), 1.0)
    assert askers.of(arm, 2.5) == Address.numbered(2)
    assert askers.of(arm, 3.1) is None


def test_no_crowd_of_robots_makes_the_memory_of_who_asked_grow() -> None:
    askers = Askers(window_s=2.0)
    arm, pc = Address.named("ARM"), Address.named("PC")
    for number in range(10_000):
        askers.note(Address.named(f"R{number}"), pc, number / 1000)
    askers.note(arm, pc, 10.0)
    assert len(askers) <= ROBOTS_KEPT
    assert askers.of(arm, 10.1) == pc
