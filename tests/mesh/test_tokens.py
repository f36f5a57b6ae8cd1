"""What another broker has declared."""

from psiu_broker.frame import Address
from psiu_broker.mesh.beat import digest
from psiu_broker.mesh.tokens import CLAIMS_MAX, EDITIONS_MAX, LIVES_MAX, AllTokens, Tokens
from psiu_broker.routing.claims import Claim


def claim(robot: str, term: int = 1) -> Claim:
    return Claim(Address.named(robot), None, "psiu-ascii", "radio", term, 10, 0)


def test_a_claim_that_is_renewed_is_declared_before_the_old_one_goes() -> None:
    tokens = Tokens()
    tokens.add(claim("MNERIM", 1))
    tokens.add(claim("MNERIM", 2))
    assert tokens.remove(claim("MNERIM", 1)) == claim("MNERIM", 2)
    assert tokens.digest == digest([claim("MNERIM", 2)])
    assert tokens.remove(claim("MNERIM", 2)) is None
    assert tokens.digest == digest(())


def test_while_all_is_declared_anew_every_claim_stands_twice_and_is_one() -> None:
    tokens = Tokens()
    tokens.add(claim("MNERIM"))
    tokens.add(claim("MNERIM"))
    assert tokens.digest == digest([claim("MNERIM")])
    assert tokens.remove(claim("MNERIM")) == claim("MNERIM")
    assert list(tokens) == [claim("MNERIM")]


def test_what_was_never_declared_can_be_withdrawn() -> None:
    tokens = Tokens()
    assert tokens.remove(claim("MNERIM")) is None
    tokens.add(claim("MNERIM", 2))
    assert tokens.remove(claim("MNERIM", 1)) == claim("MNERIM", 2)


def test_what_is_not_declared_anew_when_all_is_was_withdrawn_long_ago() -> None:
    tokens = Tokens()
    tokens.add(claim("OLD"))
    tokens.add(claim("MNERIM"))
    tokens.ask(0.0)
    tokens.add(claim("MNERIM"))
    assert set(tokens.sweep()) == {Address.named("OLD"), Address.named("MNERIM")}
    assert list(tokens) == [claim("MNERIM")]
    assert tokens.find(Address.named("OLD")) is None
    assert tokens.sweep() == []


def test_the_tokens_of_a_broker_are_bounded_and_those_of_one_that_is_there_never_forgotten() -> None:
    tokens = Tokens()
    for number in range(CLAIMS_MAX + 50):
        tokens.add(claim(f"R{number}"))
    for term in range(EDITIONS_MAX + 50):
        tokens.add(claim("R0", term))
    assert len(list(tokens)) == CLAIMS_MAX
    found = tokens.find(Address.named("R0"))
    assert found is not None
    assert found.term < EDITIONS_MAX
    every = AllTokens(lambda broker, epoch: (broker, epoch) == ("B", 0))
    kept = every.of("B", 0)
    first = every.of("C", 0)
    for epoch in range(1, LIVES_MAX):
        every.of("C", epoch)
    assert every.of("B", 0) is kept
    assert every.of("C", 0) is not first
