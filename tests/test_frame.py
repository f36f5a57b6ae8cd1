import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import Address, Way, peer_text


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("MNERIM", Address.named("MNERIM")),
        ("ROBO UM", Address.named("ROBO UM")),
        ("0x12", Address.numbered(0x12)),
        ("0xA", Address.numbered(10)),
        ("red.0x03", Address.numbered(3, "red")),
        ("0x123", Address.named("0x123")),
        ("red.MNERIM", Address.named("red.MNERIM")),
    ],
)
def test_an_address_is_read_as_people_write_it(text: str, address: Address) -> None:
    assert Address.parse(text) == address


@given(st.integers(0, 255), st.from_regex(r"[A-Za-z0-9_-]{0,8}", fullmatch=True))
def test_a_number_survives_being_written(number: int, domain: str) -> None:
    address = Address.numbered(number, domain)
    assert Address.parse(str(address)) == address
    assert address.is_numbered


@pytest.mark.parametrize(
    ("peer", "text"),
    [
        (None, None),
        (("127.0.0.1", 9001), "127.0.0.1:9001"),
        (("::1", 9001, 0, 0), "[::1]:9001"),
        ("98:D3:31:00:00:01", "98:D3:31:00:00:01"),
    ],
)
def test_a_far_end_in_words(peer: object, text: str | None) -> None:
    assert peer_text(peer) == text


def test_a_way_in_words_names_the_far_end_only_where_there_are_several() -> None:
    assert str(Way("radio")) == "radio"
    assert str(Way("wifi", ("127.0.0.1", 9001))) == "wifi/127.0.0.1:9001"
