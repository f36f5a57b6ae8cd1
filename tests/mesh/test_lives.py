"""Which brokers are announced, and who else has our name."""

from psiu_broker.mesh.lives import BROKERS_MAX, EDITIONS_MAX, LIVES_MAX, NAMESAKE_S, NAMESAKES_MAX, Lives, Namesakes


def test_a_life_is_over_with_its_last_announcement() -> None:
    lives = Lives()
    assert lives.came("B", 7, "id", "0")
    assert lives.came("B", 7, "id", "1"), "it declares everything anew"
    assert not lives.went("B", 7, "0")
    assert lives.has("B", 7)
    assert lives.went("B", 7, "1")
    assert not lives.has("B", 7)
    assert not lives.went("B", 7, "1"), "once only"


def test_what_is_left_of_a_former_life_does_not_hide_the_new_one() -> None:
    lives = Lives()
    lives.came("B", 7, "old", "0")
    lives.came("B", 9, "new", "0")
    assert (lives.latest("B"), lives.zenoh_id("B", 9)) == (9, "new")
    lives.went("B", 9, "0")
    assert lives.latest("B") == 7
    lives.went("B", 7, "0")
    assert lives.latest("B") is None


def test_no_more_brokers_are_known_than_can_be_and_those_that_are_stay() -> None:
    lives = Lives()
    assert all(lives.came(f"B{number}", 1, "id", "0") for number in range(BROKERS_MAX))
    assert not lives.came("one more", 1, "id", "0")
    assert lives.came("B0", 2, "id", "0")
    lives.went("B1", 1, "0")
    assert lives.came("one more", 1, "id", "0")


def test_one_broker_has_no_more_lives_than_can_be_and_the_ones_that_are_known_stay() -> None:
    lives = Lives()
    assert [lives.came("B", epoch, "id", "0") for epoch in range(LIVES_MAX + 1)] == [True] * LIVES_MAX + [False]
    assert lives.came("B", 0, "id", "1")
    lives.went("B", 1, "0")
    assert lives.came("B", LIVES_MAX, "id", "0")


def test_announcements_without_end_are_not_remembered() -> None:
    lives, namesakes = Lives(), Namesakes()
    for edition in range(EDITIONS_MAX + 50):
        lives.came("B", 1, "id", str(edition))
        namesakes.came(1, str(edition), 0.0)
    assert [lives.went("B", 1, str(edition)) for edition in range(EDITIONS_MAX)][-1], "the rest was never noted"
    for edition in range(EDITIONS_MAX):
        namesakes.went(1, str(edition))
    assert list(namesakes.since(100.0)) == []


def test_a_broker_of_our_name_is_a_namesake_when_it_stays() -> None:
    namesakes = Namesakes()
    namesakes.came(1, "0", 10.0)
    namesakes.came(2, "0", 10.0)
    namesakes.came(2, "1", 12.0)
    namesakes.went(1, "0")
    namesakes.went(2, "0")
    assert list(namesakes.since(10.0 + NAMESAKE_S)) == []
    assert list(namesakes.since(10.1 + NAMESAKE_S)) == [10.0]
    for epoch in range(NAMESAKES_MAX + 50):
        namesakes.came(epoch, "0", 20.0)
    assert len(list(namesakes.since(30.0))) == NAMESAKES_MAX
