import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import Address
from psiu_broker.routing.claims import Claim, Claims, age_of

MNERIM, OUTRO = Address.named("MNERIM"), Address.named("OUTRO")


def claim(robot: Address = MNERIM, term: int = 1, link: str = "radio") -> Claim:
    return Claim(robot, None, "psiu-ascii", link, term, 10, 0)


def test_the_highest_term_owns_a_robot_and_of_equal_ones_the_name_that_sorts_last() -> None:
    claims = Claims()
    assert claims.owner(MNERIM) is None
    claims.set("B", claim(term=2))
    claims.set("A", claim(term=2))
    assert claims.owner(MNERIM) == ("B", claim(term=2))
    claims.set("A", claim(term=3))
    assert claims.owner(MNERIM) == ("A", claim(term=3))
    assert dict(claims) == {"A": claim(term=3)}


def test_when_the_owner_gives_up_its_claim_the_next_one_owns_the_robot() -> None:
    claims = Claims()
    claims.set("A", claim(term=3))
    claims.set("B", claim(term=2))
    claims.remove("A", MNERIM)
    assert claims.owner(MNERIM) == ("B", claim(term=2))
    claims.remove("B", MNERIM)
    claims.remove("B", MNERIM)
    assert claims.owner(MNERIM) is None


def test_the_next_term_is_higher_than_any_seen_also_of_claims_that_are_gone() -> None:
    claims = Claims()
    assert claims.next_term(MNERIM) == 1
    claims.set("A", claim(term=7))
    claims.remove("A", MNERIM)
    claims.set("B", claim(term=2))
    assert claims.next_term(MNERIM) == 8
    assert claims.next_term(OUTRO) == 1


def test_a_broker_that_goes_takes_all_its_claims_along() -> None:
    claims = Claims()
    claims.set("A", claim(MNERIM))
    claims.set("A", claim(OUTRO))
    claims.set("B", claim(OUTRO, term=0))
    assert set(claims.remove_broker("A")) == {MNERIM, OUTRO}
    assert claims.of("A") == {}
    assert claims.owner(MNERIM) is None
    assert claims.owner(OUTRO) == ("B", claim(OUTRO, term=0))
    assert claims.remove_broker("A") == []


def test_one_broker_cannot_fill_the_memory_of_the_others() -> None:
    claims = Claims(capacity=10)
    taken = [claims.set("A", claim(Address.named(f"R{number}"))) for number in range(20)]
    assert taken == [True] * 10 + [False] * 10
    assert claims.set("A", claim(Address.named("R3"), term=9)), "a claim that it has can be renewed"
    assert claims.set("B", claim(Address.named("R15")))


def test_a_term_of_long_ago_is_forgotten_before_a_new_one() -> None:
    claims = Claims(capacity=10)
    for number in range(100):
        claims.set("A", claim(Address.named(f"R{number}"), term=5))
        claims.remove("A", Address.named(f"R{number}"))
    assert claims.next_term(Address.named("R99")) == 6
    assert claims.next_term(Address.named("R0")) == 1


@pytest.mark.parametrize(
    ("heard_at", "age_s"), [(None, None), (100.0, 0), (71.0, 0), (70.0, 30), (-500.0, 120), (101, 0)]
)
def test_the_age_in_a_claim_is_so_coarse_that_a_robot_that_talks_changes_nothing(
    heard_at: float | None, age_s: int | None
) -> None:
    assert age_of(heard_at, 100.0) == age_s


brokers, robots = st.sampled_from("ABC"), st.sampled_from([MNERIM, OUTRO])


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("set"), brokers, robots, st.integers(0, 5)),
            st.tuples(st.just("remove"), brokers, robots),
            st.tuples(st.just("remove_broker"), brokers),
        )
    )
)
def test_claims_are_what_was_set_and_not_removed_and_whoever_sees_them_names_the_same_owner(steps: list) -> None:  # type: ignore[type-arg]
    claims = Claims()
    standing: dict[tuple[str, Address], Claim] = {}
    for step in steps:
        match step:
            case ("set", broker, robot, term):
                standing[broker, robot] = claim(robot, term)
                assert claims.set(broker, standing[broker, robot])
            case ("remove", broker, robot):
                standing.pop((broker, robot), None)
                claims.remove(broker, robot)
            case ("remove_broker", broker):
                claims.remove_broker(broker)
                standing = {key: value for key, value in standing.items() if key[0] != broker}
    for broker in "ABC":
        assert claims.of(broker) == {robot: each for (name, robot), each in standing.items() if name == broker}
    late = Claims()
    for (broker, _), each in reversed(standing.items()):
        late.set(broker, each)
    assert {robot: late.owner(robot) for robot in (MNERIM, OUTRO)} == {
        robot: claims.owner(robot) for robot in (MNERIM, OUTRO)
    }
