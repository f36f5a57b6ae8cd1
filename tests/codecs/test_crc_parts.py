import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.checksums import CHECKS, CRCS, CheckName
from psiu_broker.codecs.crc_parts import LONGEST_PART, CrcParts


@pytest.mark.parametrize("name", CRCS)
@given(data=st.data())
def test_each_part_has_the_crc_that_it_has_alone_however_the_text_comes_and_goes(
    name: CheckName, data: st.DataObject
) -> None:
    check = CHECKS[name]
    assert check is not None
    parts = CrcParts(CRCS[name])
    text = b""
    begin = 0
    for piece in data.draw(st.lists(st.binary(max_size=400), max_size=6)):
        text += piece
        for _ in range(data.draw(st.integers(0, 4))):
            begin = data.draw(st.integers(begin, len(text)))
            end = data.draw(st.integers(begin, min(len(text), begin + LONGEST_PART)))
            assert parts.of(text, begin, end) == check(text[begin:end])
        gone = data.draw(st.one_of(st.just(begin), st.integers(begin, len(text))))
        parts.forget(gone)
        text, begin = text[gone:], 0


def test_a_byte_is_looked_at_once_however_many_parts_it_is_in() -> None:
    text = bytes(range(256)) * 4
    looked_at: list[int] = []

    class Counted(tuple[int, ...]):
        __slots__ = ()

        def __getitem__(self, state: int) -> int:  # type: ignore[override]
            looked_at.append(state)
            return super().__getitem__(state)

    parts = CrcParts(CRCS["smbus"]._replace(table=Counted(CRCS["smbus"].table)))
    for begin in range(len(text) - LONGEST_PART):
        parts.of(text, begin, begin + LONGEST_PART)
    assert len(looked_at) == len(text) - 1
