"""Many answers, one picture."""

from mesh_answers import NOW, broker, conflict, full, mesh, robot

from psiu_broker.cli.mesh_view import Split, composed


def test_each_pair_is_there_once_with_what_both_say() -> None:
    (pair,) = composed(
        [
            mesh("base", broker("north", rtt_ms=0.4, frames_out=7, frames_in=3, lost=1)),
            mesh("north", broker("base", rtt_ms=0.6, frames_out=4, frames_in=6, lost=2)),
        ]
    ).pairs
    assert (pair.a, pair.b, pair.rtt_ms, pair.how) == ("base", "north", 0.5, "direct")
    assert (pair.a_to_b, pair.b_to_a, pair.lost) == (7, 4, 3)


def test_a_pair_without_a_link_of_its_own_is_relayed() -> None:
    names = ("base", "north")
    told = [mesh(name, broker(other, linked=False)) for name, other in (names, names[::-1])]
    assert [pair.how for pair in composed(told).pairs] == ["relayed"]


def test_a_broker_that_does_not_answer_is_known_from_the_others() -> None:
    view = composed([mesh("base", broker("dead", frames_out=5, frames_in=2), robots=[robot("BETA", "dead")])])
    base, dead = view.brokers
    assert (base.answers, base.since, dead.answers, dead.since, dead.mode) == (True, None, False, NOW, None)
    assert (dead.robots, dead.zenoh_id) == (1, "id-dead")
    (pair,) = view.pairs
    assert (pair.a_to_b, pair.b_to_a, pair.how) == (5, 2, "direct")
    assert view.splits == ()


def test_who_is_seen_by_some_but_not_by_all_is_a_split() -> None:
    view = composed([mesh("a", broker("b"), broker("c")), mesh("b", broker("a")), mesh("c", broker("a"))])
    assert view.splits == (Split("b", ("a",), ("c",)), Split("c", ("a",), ("b",)))
    assert [(pair.a, pair.b) for pair in view.pairs] == [("a", "b"), ("a", "c")]


def test_sight_in_one_direction_only_is_said() -> None:
    (pair,) = composed([mesh("a"), mesh("b", broker("a"))]).pairs
    assert pair.how == "only b sees it"


def test_a_robot_is_there_once_as_its_owner_tells_it() -> None:
    view = composed(
        [
            mesh("base", broker("north"), robots=[robot("BETA", "north", age_s=9, quality=0.1)]),
            mesh("north", broker("base"), robots=[robot("BETA", "north", age_s=1, quality=0.8)]),
        ]
    )
    (beta,) = view.robots
    assert (beta.told.age_s, beta.told.quality, beta.known_to) == (1, 0.8, ("base", "north"))
    assert view.robots_of("north") == [beta]
    assert view.robots_of("base") == []


def test_of_several_that_claim_a_robot_the_highest_claim_is_the_owner_s() -> None:
    claims = [robot("BETA", "base", term=3), robot("BETA", "gate", term=3), robot("BETA", "north", term=2)]
    (beta,) = composed(full("base", "gate", "north", robots=claims)).robots
    assert (beta.told.owner, beta.claimed_by) == ("gate", ("base", "gate", "north"))
    assert len(beta.known_to) == 3


def test_brokers_that_do_not_agree_on_an_owner_are_both_shown() -> None:
    view = composed(
        [
            mesh("base", broker("north"), robots=[robot("BETA", "base")]),
            mesh("north", broker("base"), robots=[robot("BETA", "north", term=2)]),
        ]
    )
    assert [(each.told.owner, each.known_to) for each in view.robots] == [("base", ("base",)), ("north", ("north",))]


def test_a_conflict_is_one_since_it_was_first_noticed() -> None:
    told = full("base", "north")
    told[0].conflicts.append(conflict("BETA", "base", "north", later_s=5))
    told[1].conflicts.append(conflict("BETA", "north", "gate"))
    (found,) = composed(told).conflicts
    assert (found.brokers, found.since) == (["base", "gate", "north"], NOW)
    assert composed(told).contested == {"BETA"}
