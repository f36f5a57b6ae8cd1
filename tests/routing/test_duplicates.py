from psiu_broker.frame import MESH, Way
from psiu_broker.routing.duplicates import Duplicates

RADIO, WIFI, ARM = Way("radio"), Way("wifi", ("127.0.0.1", 9001)), Way("arm")


def test_the_same_frame_by_another_way_within_the_window_is_a_double() -> None:
    duplicates = Duplicates(1.0)
    assert not duplicates.is_double(b"frame", RADIO, 0.0)
    assert duplicates.is_double(b"frame", WIFI, 0.5)
    assert duplicates.is_double(b"frame", ARM, 1.0)


def test_the_same_frame_by_the_same_way_is_a_person_pressing_twice() -> None:
    duplicates = Duplicates(1.0)
    assert not duplicates.is_double(b"frame", RADIO, 0.0)
    assert not duplicates.is_double(b"frame", RADIO, 0.2)


def test_a_double_of_the_second_press_is_still_a_double_whichever_copy_comes_first() -> None:
    duplicates = Duplicates(1.0)
    heard = [(RADIO, 0.0), (WIFI, 0.01), (WIFI, 0.20), (RADIO, 0.21), (WIFI, 0.40), (RADIO, 0.41)]
    passed = [at for way, at in heard if not duplicates.is_double(b"frame", way, at)]
    assert passed == [0.0, 0.21, 0.41]


def test_two_peers_of_one_link_are_two_ways_for_a_moment() -> None:
    duplicates = Duplicates(1.0, same_link_s=0.25)
    assert not duplicates.is_double(b"frame", WIFI, 0.0)
    assert duplicates.is_double(b"frame", Way("wifi", ("127.0.0.1", 9002)), 0.2)


def test_a_program_that_sends_each_command_from_a_new_port_may_repeat_itself() -> None:
    duplicates = Duplicates(1.0, same_link_s=0.25)
    passed = [duplicates.is_double(b"frame", Way("wifi", ("127.0.0.1", port)), port * 0.3) for port in range(5)]
    assert not any(passed)


def test_after_the_window_another_way_may_bring_it() -> None:
    duplicates = Duplicates(1.0)
    assert not duplicates.is_double(b"frame", RADIO, 0.0)
    assert not duplicates.is_double(b"frame", WIFI, 1.1)
    assert duplicates.is_double(b"frame", RADIO, 1.2)


def test_a_robot_that_moved_while_repeating_itself_is_heard_after_one_window() -> None:
    duplicates = Duplicates(1.0)
    for tenth in range(50):
        assert not duplicates.is_double(b"frame", RADIO, tenth / 10)
    passed = [tenth / 10 for tenth in range(50, 80) if not duplicates.is_double(b"frame", WIFI, tenth / 10)]
    assert passed[0] <= 6.0
    assert len(passed) >= 19


def test_the_memory_survives_a_change_of_generation() -> None:
    duplicates = Duplicates(1.0)
    duplicates.is_double(b"other", RADIO, 0.0)
    duplicates.is_double(b"frame", RADIO, 0.99)
    duplicates.is_double(b"other still", RADIO, 1.01)
    assert duplicates.is_double(b"frame", WIFI, 1.5)


def test_questions_which_may_wait_longer_have_a_longer_window() -> None:
    duplicates = Duplicates(1.0, question_s=3.0)
    for subject, at, double in (("qualseunome", 2.9, True), ("parafrente", 1.0, True), ("parafrente", 1.1, False)):
        key = subject, at
        assert not duplicates.is_double(key, RADIO, 0.0, subject)
        assert duplicates.knows(key, WIFI, at, subject) is double
        assert duplicates.is_double(key, WIFI, at, subject) is double


def test_a_double_does_not_count_as_heard() -> None:
    duplicates = Duplicates(1.0)
    duplicates.is_double(b"other", RADIO, 0.0)
    duplicates.is_double(b"frame", RADIO, 0.9)
    assert duplicates.is_double(b"frame", WIFI, 1.1)
    assert duplicates.is_double(b"frame", WIFI, 1.2)
    assert not duplicates.is_double(b"frame", RADIO, 1.3)
    assert not duplicates.is_double(b"frame", WIFI, 2.4)


def test_a_full_memory_forgets_its_older_half_only() -> None:
    duplicates = Duplicates(1.0, capacity=100)
    for number in range(150):
        duplicates.is_double(number, RADIO, 0.0)
    assert all(duplicates.is_double(number, WIFI, 0.5) for number in range(150))
    for number in range(150, 200):
        assert not duplicates.is_double(number, RADIO, 0.5)
    assert not duplicates.is_double(200, RADIO, 0.5)
    assert not duplicates.is_double(0, WIFI, 0.5)
    assert duplicates.is_double(100, WIFI, 0.5)


def test_when_the_leading_link_is_gone_another_way_brings_repeats() -> None:
    duplicates = Duplicates(4.0, same_link_s=0.25)
    for generation, at in ((b"old", 0.0), (b"frame", 3.0), (b"new", 4.5), (b"just now", 4.9)):
        duplicates.is_double(generation, RADIO, at)
    duplicates.is_double(b"other", ARM, 4.5)
    duplicates.forget("radio", 5.0)
    assert not duplicates.is_double(b"frame", WIFI, 5.0)
    assert not duplicates.is_double(b"new", WIFI, 5.0)
    assert duplicates.is_double(b"just now", WIFI, 5.0), "its copy may have been on the way"
    assert duplicates.is_double(b"other", WIFI, 5.0)


def test_memory_is_bounded_under_a_flood_of_different_frames() -> None:
    duplicates = Duplicates(1.0, capacity=100)
    for number in range(10_000):
        duplicates.is_double(number, RADIO, 0.0)
    assert len(duplicates._new) + len(duplicates._old) <= 200


BROKER = Way(MESH, "B")


def test_what_a_link_of_ours_brought_is_known_with_its_time() -> None:
    duplicates = Duplicates(1.0)
    assert not duplicates.heard_here(b"frame", -1e9)
    duplicates.is_double(b"frame", RADIO, 10.0)
    assert duplicates.heard_here(b"frame", 10.0)
    assert not duplicates.heard_here(b"frame", 10.1)
    duplicates.is_double(b"frame", RADIO, 10.5)
    assert duplicates.heard_here(b"frame", 10.4), "said again"


def test_what_only_another_broker_brought_was_not_heard_here() -> None:
    duplicates = Duplicates(1.0)
    duplicates.is_double(b"frame", BROKER, 10.0)
    assert not duplicates.heard_here(b"frame", 0.0)


def test_a_link_of_ours_leads_before_another_broker_however_quick_that_was() -> None:
    duplicates = Duplicates(1.0)
    assert not duplicates.is_double(b"frame", BROKER, 10.0)
    assert duplicates.is_double(b"frame", RADIO, 10.1)
    assert duplicates.heard_here(b"frame", 10.0)
    assert not duplicates.is_double(b"frame", RADIO, 10.5), "the robot says it again, and our radio leads"
    assert duplicates.is_double(b"frame", BROKER, 10.6)


def test_of_two_links_of_ours_the_quicker_one_goes_on_leading() -> None:
    duplicates = Duplicates(1.0)
    assert not duplicates.is_double(b"frame", RADIO, 10.0)
    assert duplicates.is_double(b"frame", ARM, 10.1)
    assert duplicates.is_double(b"frame", ARM, 10.2)
