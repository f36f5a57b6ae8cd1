"""Phones that hang up and call again at an awkward moment; their connections are Unix sockets, without BlueZ."""

import asyncio
import socket
from typing import Any

import pytest
from adapter_contract import Recorder

from psiu_adapters.bluez import Bluez
from psiu_adapters.rfcomm import Accepting, Rfcomm

PHONE = "98:D3:31:00:00:01"


@pytest.fixture
async def bluez(monkeypatch: pytest.MonkeyPatch) -> Bluez:
    """One whose link accepts, of which no bus knows."""

    async def release() -> None:
        pass

    bluez = Bluez()
    monkeypatch.setattr(bluez.bus, "release", release)
    monkeypatch.setattr(bluez, "stop_accepting", lambda controller: None)
    return bluez


def call(accepting: Accepting) -> socket.socket:
    """The phone calls; its end of the connection."""
    ours, theirs = socket.socketpair()
    accepting.connected(PHONE, ours.detach())
    return theirs


def hang_up_unheard(accepting: Accepting, phone: socket.socket) -> None:
    """The phone is gone, which writing notices now and says in the loop's next turn."""
    phone.close()
    assert accepting.write(b"into the dark", PHONE) is True


async def test_a_phone_that_calls_again_before_its_loss_is_said_keeps_the_new_call(
    bluez: Bluez, recorder: Recorder
) -> None:
    accepting = Accepting(recorder, "hci0", bluez)
    hang_up_unheard(accepting, call(accepting))
    with call(accepting) as again:
        assert recorder.gone == [PHONE]
        again.send(b"here again")
        await recorder.until(lambda: recorder.heard)
        assert recorder.heard == [(b"here again", PHONE)]
        assert recorder.gone == [PHONE], "said once, of the first call"
        assert tuple(accepting.peers) == (PHONE,)
        await accepting.close()


async def test_a_loss_that_is_said_after_the_link_was_closed_is_nobody_s(bluez: Bluez, recorder: Recorder) -> None:
    failures: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, failure: failures.append(failure))
    accepting = Accepting(recorder, "hci0", bluez)
    hang_up_unheard(accepting, call(accepting))
    await accepting.close()
    await asyncio.sleep(0)
    assert failures == []
    assert recorder.gone == []


def test_a_phone_is_named_by_its_address_in_either_case_and_only_where_phones_call() -> None:
    assert Rfcomm(accept=True).peer_named("98:d3:31:00:00:0a") == "98:D3:31:00:00:0A"
    with pytest.raises(ValueError, match="not a Bluetooth address: six hex pairs"):
        Rfcomm(accept=True).peer_named("my phone")
    with pytest.raises(ValueError, match="a single one; remove it"):
        Rfcomm(address=PHONE).peer_named(PHONE)
