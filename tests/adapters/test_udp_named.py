"""Whom the UDP adapter calls named: this computer, and who is listed; whoever else sends is a stranger."""

import socket

import pytest
from adapter_contract import FRAME, Recorder
from udp_robot import Robot, open_for

from psiu_adapters.udp import Udp


def own_address() -> str:
    """An address of this computer that is no loopback one; "" where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return ""
        return str(probe.getsockname()[0])


OUTSIDE = own_address()


@pytest.mark.parametrize(
    ("listen", "learn", "exposed"),
    [
        ("127.0.0.1:0", True, False),
        ("127.8.9.1:0", True, False),
        ("localhost:0", True, False),
        ("[::1]:0", True, False),
        ("0.0.0.0:0", True, True),
        ("[::]:0", True, True),
        ("192.0.2.1:0", True, True),
        ("robots.local:0", True, True),
        ("0.0.0.0:0", False, False),
    ],
)
def test_a_port_that_learns_senders_from_beyond_this_computer_is_exposed(
    listen: str, learn: bool, exposed: bool
) -> None:
    assert Udp(listen=listen, learn=learn).exposed is exposed


async def test_a_program_on_this_computer_is_named_and_an_address_never_heard_is_not(
    robot: Robot, recorder: Recorder
) -> None:
    transport = await open_for(recorder, [robot], listen="0.0.0.0:0")
    robot.broker = ("127.0.0.1", robot.broker[1])
    await robot.say(FRAME)
    await recorder.until(lambda: recorder.heard)
    assert transport.is_named(recorder.heard[0][1])
    assert not transport.is_named(("192.0.2.77", 9001))
    await transport.close()


@pytest.mark.skipif(not OUTSIDE, reason="this computer has no address that others reach")
@pytest.mark.parametrize("listed", [True, False])
async def test_another_address_is_named_only_where_it_is_listed(recorder: Recorder, listed: bool) -> None:
    robot = Robot(host=OUTSIDE)
    peers = (robot.text,) if listed else ()
    transport = await open_for(recorder, [robot], listen="0.0.0.0:0", peers=peers)
    robot.broker = (OUTSIDE, robot.broker[1])
    await robot.say(FRAME)
    await recorder.until(lambda: recorder.heard)
    assert transport.is_named(recorder.heard[0][1]) is listed
    await transport.close()
    robot.socket.close()
