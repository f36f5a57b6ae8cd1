"""However many bytes a stranger has sent, one more costs the same. Figures: python -m tests.bench.cost_per_byte"""

import pytest
from attack.costs import cost_us, held_bytes
from attack.crafted import CRAFTS, Craft

FEW, MANY = 1_000, 32_000
SOME = 16 * FEW
"""One byte at a time, beside half of few."""
TIMES = 8
"""Quadratic would be 32 times as dear; a loaded machine's clock is not that wrong."""
HALF_US = 0.5
"""Under it, a byte only waited for the rest of a packet."""
HELD = 40_000
"""Bytes that a codec keeps at most: of a packet of soccer 16,322, of a run of PSIU ASCII 8,200 and their sums."""
FRAGMENTS = "psiu-hexa, first pieces"
"""Whose bound, 16 messages of 65,281 bytes, is told in tests/codecs/test_fragments.py."""

crafts = pytest.mark.parametrize("craft", CRAFTS, ids=[craft.name for craft in CRAFTS])


@crafts
def test_a_byte_among_many_costs_no_more_than_among_few(craft: Craft) -> None:
    for _ in range(3):
        few = cost_us(craft, FEW, FEW, 3)
        many = cost_us(craft, MANY, MANY, 1)
        if many <= TIMES * max(few, HALF_US):
            return
    pytest.fail(f"{many:.2f} µs a byte of {MANY} and {few:.2f} µs of {FEW}")


@crafts
def test_one_byte_at_a_time_it_costs_no_more_either(craft: Craft) -> None:
    for _ in range(3):
        few = cost_us(craft, FEW // 2, 1, 2)
        many = cost_us(craft, SOME, 1, 1)
        if many <= TIMES * max(few, HALF_US):
            return
    pytest.fail(f"{many:.2f} µs a byte of {SOME} and {few:.2f} µs of {FEW // 2}")


@pytest.mark.parametrize("craft", [craft for craft in CRAFTS if craft.name != FRAGMENTS], ids=lambda craft: craft.name)
def test_a_codec_keeps_little_of_an_endless_stream(craft: Craft) -> None:
    codec = craft.make()
    before = held_bytes(codec)
    piece = craft.of_size(4096)
    for _ in range(3):
        for _ in range(4):
            codec.decode(piece, 0.0)
        assert held_bytes(codec) - before <= HELD
