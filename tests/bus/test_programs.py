"""Programs that are missed: over TLS with rights, and by the broker that has the robot, which may be another one."""

import asyncio
from pathlib import Path

import pytest
from secure_lab import SecureLab, until

from psiu_broker.bus.keys import Keys
from psiu_broker.failsafe import AWAITED_S
from psiu_broker.messages import CallRequest

FAILSAFE = '[robots.MNERIM]\nlink = "wifi"\nfailsafe = { command = "paratras", parameters = [1] }\n'
ONE_CM = CallRequest(parameters=[1])


@pytest.mark.parametrize("names", [("base",), ("base", "hill")], ids=["its own broker", "another broker"])
async def test_a_program_that_breaks_off_is_missed_and_one_that_is_done_is_not(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    async with SecureLab(tmp_path, names, extra=FAILSAFE) as lab:
        done, broken = lab.client("operator"), lab.client("operator")
        await asyncio.to_thread(done.call, "MNERIM", "parafrente", ONE_CM)
        done.close()
        await asyncio.sleep(AWAITED_S + 0.3)
        assert lab.robot.position.x == 1
        await asyncio.to_thread(broken.call, "MNERIM", "parafrente", ONE_CM)
        assert lab.robot.position.x == 2
        broken.close(done=False)
        await until(lambda: lab.robot.position.x == 1)


def test_a_token_names_a_program_and_says_whether_it_goes_in_good_order() -> None:
    keys = Keys()
    assert keys.read_program(keys.program("painel")) == ("painel", False)
    assert keys.read_program("psiu/@program/painel/done") == ("painel", True)
    for other in (
        "psiu/@program",
        "psiu/@program/a/b",
        "psiu/@program/a/done/c",
        "psiu/a",
        "other/@program/a",
        "psiu/@program/@radio",
        "psiu/@program/%40radio/done",
    ):
        with pytest.raises(ValueError, match=r"is not"):
            keys.read_program(other)
