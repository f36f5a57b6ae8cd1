import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from crccheck import crc as oracle
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.checksums import CHECKS, CheckName, byte_sum, crc8_table

CHECK_INPUT = b"123456789"
ORACLES: dict[CheckName, Any] = {
    "smbus": oracle.Crc8Smbus,
    "maxim-dow": oracle.Crc8MaximDow,
    "dvb-s2": oracle.Crc8DvbS2,
    "nrsc-5": oracle.Crc8Nrsc5,
}
PUBLISHED = json.loads((Path(__file__).parents[1] / "vectors" / "psiu-hexa.json").read_text())["check"]
SUMS: dict[CheckName, Callable[[bytes], int]] = {
    "sum": lambda data: sum(data) % 256,
    "negsum": lambda data: (256 - sum(data) % 256) % 256,
}


def compute(name: CheckName, data: bytes) -> int:
    check = CHECKS[name]
    assert check is not None
    return check(data)


@pytest.mark.parametrize("name", ORACLES)
def test_each_crc_gives_its_published_check_value(name: CheckName) -> None:
    assert compute(name, CHECK_INPUT) == int(PUBLISHED[name], 16)


@pytest.mark.parametrize("name", ORACLES)
@given(data=st.binary(max_size=300))
def test_each_crc_agrees_with_an_independent_library(name: CheckName, data: bytes) -> None:
    assert compute(name, data) == ORACLES[name].calc(data)


@pytest.mark.parametrize("name", SUMS)
@given(data=st.binary(max_size=300))
def test_the_sums_are_what_they_are_called(name: CheckName, data: bytes) -> None:
    assert compute(name, data) == SUMS[name](data)


@given(data=st.binary(max_size=300))
def test_the_xor_of_a_message_and_its_check_is_nothing(data: bytes) -> None:
    assert compute("xor", data + bytes((compute("xor", data),))) == 0


def test_none_means_that_there_is_no_check_byte() -> None:
    assert CHECKS["none"] is None


def test_a_table_has_one_remainder_for_each_byte() -> None:
    assert sorted(crc8_table(0x07)) == list(range(256))
    assert crc8_table(0x07)[1] == 0x07
    assert crc8_table(0x31, reflected=True)[0x80] == 0x8C


@given(data=st.one_of(st.binary(max_size=1100), st.integers(0, 1100).map(lambda size: b"\xff" * size)))
def test_the_byte_sum_is_the_sum_modulo_65536_at_any_length(data: bytes) -> None:
    assert byte_sum(data) == sum(data) % 65536


@pytest.mark.parametrize("size", [255, 256, 257, 258, 999])
def test_the_byte_sum_is_right_where_its_two_ways_meet(size: int) -> None:
    assert byte_sum(b"\xff" * size) == 255 * size % 65536
