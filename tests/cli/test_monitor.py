"""One terminal watches while another calls."""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from psiu_broker.cli.monitor import message_line
from psiu_broker.messages import Card, Decoded, RawFrame

Start = Callable[..., Any]


def patiently() -> Iterator[None]:
    """Again and again, but not for ever."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        yield


@pytest.fixture
def watch(lab: Any, start: Start) -> Callable[..., Any]:
    @contextmanager
    def watching(*words: str, sign: str, robot: str = "MNERIM", command: str = "distancia") -> Iterator[Any]:
        """`psiu monitor`, once it has seen a call: nobody is told when it begins to listen."""
        monitor = start("psiu", "monitor", *words, env=lab.env)
        for _ in patiently():
            lab.run("call", robot, command)
            if any(sign in line for line in tuple(monitor.out)):
                break
            assert monitor.popen.poll() is None, monitor.err
        yield monitor
        monitor.signal(signal.SIGINT)
        assert monitor.ended() == 0
        assert monitor.err == []

    return watching


def test_a_person_reads_when_who_what_and_where_until_ctrl_c(watch: Any, lab: Any) -> None:
    with watch(sign="distancia 42") as monitor:
        lab.run("call", "BRACO", "garra", "30")
        monitor.until(r"^\d\d:\d\d:\d\d\.\d\d\d  MNERIM → base  distancia 42  radio$")
        monitor.until(r"^\S+  base → BRACO  garra 29\.76 deg \(node 4, signal 42\)  @self$")
        monitor.until(r"BRACO → base  ack  arm$")


def test_a_program_reads_one_object_a_line(watch: Any, lab: Any) -> None:
    with watch("--json", sign='"command":"distancia"') as monitor:
        lab.run("call", "MNERIM", "trava")
        monitor.until('"falha"')
        lab.run("discover")
        monitor.until('"link_state"')
    seen = [json.loads(line) for line in monitor.out]
    frames = [Decoded.model_validate(each) for each in seen if "kind" in each]
    cards = [Card.model_validate(each) for each in seen if "link_state" in each]
    assert len(frames) + len(cards) == len(seen)
    assert cards
    answer = next(each for each in seen if each.get("status") == "falha")
    assert answer["key"] == "psiu/MNERIM/base/trava"


@pytest.mark.parametrize("name", ["BRACO", "0x12"])
def test_one_robot_is_watched_by_its_name_or_its_address(watch: Any, lab: Any, name: str) -> None:
    with watch(name, "--json", sign='"node"', robot="BRACO", command="sonar") as monitor:
        lab.run("call", "MNERIM", "distancia")
        lab.run("call", "BRACO", "garra", "7")
        monitor.until('"command":"garra"')
    told = [json.loads(line) for line in monitor.out]
    assert all("BRACO" in (each.get("source"), each.get("destination"), each.get("robot")) for each in told)


def test_a_key_with_wildcards_is_taken_as_it_is(watch: Any, lab: Any) -> None:
    with watch("psiu/*/*/trava", sign="trava", command="trava") as monitor:
        lab.run("call", "MNERIM", "distancia")
        lab.run("call", "MNERIM", "trava")
    assert all("trava" in line for line in monitor.out)


@pytest.mark.parametrize("link", ["radio", "all"])
def test_the_raw_frames_of_a_link_come_with_verdict_and_bytes(watch: Any, lab: Any, link: str) -> None:
    with watch("--raw", link, "--json", sign='"direction":"in"') as monitor:
        lab.run("call", "MNERIM", "distancia")
        monitor.until('"direction":"out"')
    frames = [RawFrame.model_validate(json.loads(line)) for line in monitor.out]
    assert any(frame.direction == "out" and bytes.fromhex(frame.wire).startswith(b"MNERIM ") for frame in frames)
    assert ({frame.link for frame in frames} == {"radio"}) == (link == "radio")


def test_raw_frames_are_one_line_for_a_person(watch: Any, lab: Any) -> None:
    with watch("--raw", "radio", sign="distancia") as monitor:
        lab.run("call", "MNERIM", "distancia")
        monitor.until(r"^\S+  radio in  MNERIM → base  distancia  answered  [0-9a-f]+$")
        monitor.until(r"^\S+  radio out  base → MNERIM  distancia  delivered  [0-9a-f]+$")


def test_a_closed_pipe_ends_it_quietly(lab: Any, start: Start) -> None:
    reading, writing = os.pipe()
    monitor = start("psiu", "monitor", env=lab.env, stdout=writing)
    os.close(reading)
    os.close(writing)
    for _ in patiently():
        lab.run("call", "MNERIM", "distancia")
        if monitor.popen.poll() is not None:
            break
    assert (monitor.ended(), monitor.err) == (0, [])


def test_a_wrong_key_is_told_on_one_line(lab: Any) -> None:
    refused = lab.run("monitor", "psiu//x")
    assert refused.exit_code == 3
    assert "not a key" in refused.stderr
    assert lab.run("monitor", "MNERIM", "--raw", "radio").exit_code == 2


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=4,
)
FIELDS = sorted({*Decoded.model_fields, *RawFrame.model_fields, *Card.model_fields, "gone"})


@given(st.dictionaries(st.sampled_from(FIELDS), JSON))
@example({"kind": "command", "source": "PC", "parameters": 5})
@example({"kind": "node", "source": "PC", "command": "garra", "value": "wide"})
@example({"link_state": "open", "commands": 3})
@example({"kind": "command", "source": "PC", "received": "0001-01-01T00:00:00+14:00"})
def test_whatever_anybody_puts_on_the_bus_is_one_line(message: dict[str, Any]) -> None:
    assert len(message_line("psiu/PC/base/oi", message).splitlines()) == 1
