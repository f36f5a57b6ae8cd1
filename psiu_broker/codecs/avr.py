"""The small buffers of AVR robots' firmware, which a longer PSIU ASCII frame overruns."""

from typing import Final

from psiu_broker.codecs.checksums import byte_sum

WORD_BYTES: Final = 20
GREATEST_SUM: Final = 32767
"""It adds in signed 16 bits."""


def avr_trouble(wire: bytes) -> str | None:
    """Why such a robot would not understand the PSIU ASCII frame `wire`; None where it would."""
    longest = max(wire.split(b" "), key=len)
    if len(longest) > WORD_BYTES:
        return f"{longest.decode('ascii', 'replace')} is longer than the {WORD_BYTES} bytes that it keeps of a word"
    total = byte_sum(wire[:-5])
    if total > GREATEST_SUM:
        return f"its bytes add up to {total}, and it counts to {GREATEST_SUM}"
    return None
