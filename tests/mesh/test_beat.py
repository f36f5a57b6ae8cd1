import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.frame import Address
from psiu_broker.mesh.beat import Beat, Notice, digest
from psiu_broker.routing.claims import Claim


def claim(robot: str, term: int = 1) -> Claim:
    return Claim(Address.named(robot), None, "psiu-ascii", "radio", term, 10, 0)


def test_a_beat_is_the_same_after_its_way_as_json() -> None:
    beat = Beat(broker="A", epoch=2**64 - 1, sent_us=2**62, heard={"B": (1, 2)}, claims=digest([claim("MNERIM")]))
    assert Beat.model_validate_json(beat.model_dump_json()) == beat


@pytest.mark.parametrize(
    "wrong",
    [
        {"broker": ""},
        {"epoch": -1},
        {"epoch": 2**64},
        {"sent_us": -1},
        {"sent_us": 2**63},
        {"heard": {"B": (1,)}},
        {"heard": {"B": (1, -1)}},
        {"heard": {str(number): (1, 1) for number in range(5000)}},
        {"heard": {"x" * 256: (1, 1)}},
        {"sent": {str(number): (1, {}) for number in range(5000)}},
        {"sent": {"x" * 256: (1, {})}},
        {"sent": {"B": (2**64, {})}},
        {"sent": {"B": (1, {0: -1})}},
        {"sent": {"B": (1, {0: 2**63})}},
        {"sent": {"B": (1, dict.fromkeys(range(17), 1))}},
        {"unseen": [str(number) for number in range(5000)]},
        {"unseen": ["x" * 256]},
        {"broker": "x" * 256},
        {"zenoh_id": "0" * 33},
        {"claims": "x" * 65},
    ],
)
def test_a_beat_that_cannot_be_is_none(wrong: dict[str, object]) -> None:
    right: dict[str, object] = {"broker": "A", "epoch": 1, "sent_us": 1}
    Beat.model_validate(right)
    with pytest.raises(ValidationError):
        Beat.model_validate(right | wrong)


@pytest.mark.parametrize(
    "wrong", [{"broker": ""}, {"broker": "x" * 256}, {"quality": 11}, {"quality": -1}, {"frame": "0" * 200_001}]
)
def test_a_notice_that_cannot_be_is_none(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Notice.model_validate({"broker": "A"} | wrong)


def test_what_a_later_version_adds_does_no_harm() -> None:
    assert Beat.model_validate({"broker": "A", "epoch": 1, "sent_us": 1, "mood": "good"}).broker == "A"


@given(st.permutations([claim("A"), claim("B"), claim("B", 2), claim("\ud800")]))
def test_a_digest_does_not_depend_on_the_order(claims: list[Claim]) -> None:
    assert digest(claims) == digest([claim("A"), claim("B"), claim("B", 2), claim("\ud800")])


def test_any_difference_shows_in_the_digest() -> None:
    digests = {digest(claims) for claims in ([], [claim("A")], [claim("A", 2)], [claim("B")], [claim("A"), claim("B")])}
    assert len(digests) == 5
