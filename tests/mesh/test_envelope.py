import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.errors import EncodeError
from psiu_broker.frame import EVERYONE, NOBODY, Address, Frame
from psiu_broker.mesh.envelope import LONGEST, Envelope, pack, unpack

names = st.text(st.characters(blacklist_characters="\0", blacklist_categories=("Cs",)), min_size=1, max_size=40)
printable = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), min_size=1, max_size=60)
numbers = st.builds(Address.numbered, st.integers(0, 255), st.sampled_from(["", "red"]))

words = st.builds(
    lambda source, destination, text: psiu_ascii.message(source, destination, *text.split(" ")),
    st.builds(Address.named, names),
    st.one_of(st.just(EVERYONE), st.builds(Address.named, names)),
    printable,
)
packets = st.builds(psiu_hexa.packet, st.one_of(st.just(NOBODY), numbers), numbers, st.binary(max_size=200)).filter(
    lambda frame: frame is not None
)

bits = st.integers(0, 2**64 - 1)
envelopes = st.builds(Envelope, bits, bits, bits, bits, st.integers(0, 2**32 - 1), st.one_of(words, packets))


def envelope(frame: Frame) -> Envelope:
    return Envelope(1, 2, 3, 4, 5, frame)


MESSAGE = psiu_ascii.message(Address.named("PC"), Address.named("MNERIM"), "parafrente", "100")


@given(envelopes)
def test_what_is_unpacked_is_what_was_packed(sent: Envelope) -> None:
    assert unpack(pack(sent)) == sent


@given(envelopes, st.data())
def test_a_cut_envelope_is_none_or_a_shorter_message_and_never_an_exception(
    sent: Envelope, data: st.DataObject
) -> None:
    whole = pack(sent)
    cut = whole[: data.draw(st.integers(0, len(whole)))]
    found = unpack(cut)
    if found is not None:
        assert found[:5] == sent[:5]
        assert found.frame.source == sent.frame.source
        assert sent.frame.payload.startswith(found.frame.payload)


@given(envelopes, st.data())
def test_a_spoilt_envelope_raises_nothing(sent: Envelope, data: st.DataObject) -> None:
    spoilt = bytearray(pack(sent))
    for _ in range(data.draw(st.integers(1, 4))):
        spoilt[data.draw(st.integers(0, len(spoilt) - 1))] = data.draw(st.integers(0, 255))
    unpack(bytes(spoilt))


@given(st.one_of(st.binary(max_size=200), st.binary(min_size=42, max_size=300).map(lambda data: b"\x01" + data)))
def test_any_bytes_raise_nothing(data: bytes) -> None:
    unpack(data)


def test_nothing_of_the_wire_travels() -> None:
    heard = MESSAGE._replace(wire=b"\xff rm -rf", dialect="psiu-ascii/1", remark="loose")
    data = pack(envelope(heard))
    assert b"rm -rf" not in data
    assert unpack(data) == envelope(MESSAGE)


def test_a_name_with_a_nul_is_refused() -> None:
    for frame in (
        MESSAGE._replace(source=Address.named("A\0B")),
        MESSAGE._replace(destination=Address.named("\0")),
        MESSAGE._replace(protocol="psiu\0"),
    ):
        with pytest.raises(EncodeError):
            pack(envelope(frame))


def test_a_lone_surrogate_is_no_exception_on_the_other_side() -> None:
    assert unpack(pack(envelope(MESSAGE._replace(source=Address.named("\ud800"))))) is None


def test_what_is_too_long_is_refused() -> None:
    with pytest.raises(EncodeError, match="too long"):
        pack(envelope(MESSAGE._replace(payload=b"x" * (LONGEST + 1))))


@pytest.mark.parametrize(
    "frame",
    [
        MESSAGE._replace(protocol="smoke-signals"),
        MESSAGE._replace(source=Address("PC", 5)),
        MESSAGE._replace(source=Address("PC", domain="red")),
        MESSAGE._replace(destination=Address("MNERIM", domain="red")),
        MESSAGE._replace(source=Address(domain="red")),
        MESSAGE._replace(destination=Address("", 256)),
        MESSAGE._replace(destination=Address("", -2)),
        MESSAGE._replace(payload="olá".encode()),
    ],
)
def test_what_no_broker_would_send_is_no_frame(frame: Frame) -> None:
    assert unpack(pack(envelope(frame))) is None


def test_another_version_is_no_frame() -> None:
    data = pack(envelope(MESSAGE))
    assert unpack(bytes([data[0] + 1]) + data[1:]) is None


def test_an_age_beyond_all_bounds_is_the_greatest_that_can_be_said() -> None:
    found = unpack(pack(Envelope(1, 2, 3, 4, 2**40, MESSAGE)))
    assert found is not None
    assert found.age_ms == 2**32 - 1
    found = unpack(pack(Envelope(1, 2, 3, 4, -7, MESSAGE)))
    assert found is not None
    assert found.age_ms == 0
