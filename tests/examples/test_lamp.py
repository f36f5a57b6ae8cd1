"""The protocol that CONTRIBUTING.md adds: its two files and its entry are enough for a whole broker."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from examples.lamp.codec import Lamp
from examples.lamp.profile import LampProfile
from hypothesis import given
from hypothesis import strategies as st
from test_protocols import lab, link, message, until

from psiu_broker import protocols
from psiu_broker.codecs.codec import Directory
from psiu_broker.config import json_schema, load
from psiu_broker.errors import CallError, ConfigurationError, EncodeError
from psiu_broker.frame import NOBODY, Frame, Malformed
from psiu_broker.protocols import Protocol
from psiu_broker.simulator import AsciiRobot, PtyPort
from psiu_broker.simulator.robot import Reply, Robot

HERE = Path(__file__).parent
CONTRIBUTING = (HERE.parents[1] / "CONTRIBUTING.md").read_text()
ENTRY = Protocol(Lamp, LampProfile)
CONFIGURATION = """
[links.mesa]
adapter = "serial"
device = "/dev/serial/by-id/usb-FTDI_FT232R_LUZ-if00-port0"
protocol = "lamp"
[robots.LUZ]
link = "mesa"
"""


class LampRobot(Robot):
    """A lamp that may be `broken`, and then stays dark."""

    protocol = "lamp"
    name = "LUZ"

    def __init__(self, *, broken: bool = False) -> None:
        super().__init__()
        self.on = False
        self._broken = broken

    def receive(self, data: bytes, now: float) -> list[Reply]:
        replies: list[Reply] = []
        for byte in data:
            if byte in b"01" and not self._broken:
                self.on = byte == ord("1")
            if byte in b"01?":
                replies.append((0.0, self.telemetry()))
        return replies

    def boundary(self) -> None:
        pass

    def hello(self) -> bytes:
        return self.telemetry()

    def telemetry(self) -> bytes:
        return b"%d" % self.on


@pytest.fixture(autouse=True)
def _entered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(protocols.PROTOCOLS, "lamp", ENTRY)
    monkeypatch.setitem(protocols.CODECS, "lamp", ENTRY.codec)
    yield


async def test_a_whole_broker_calls_a_lamp(tmp_path: Path) -> None:
    lamp = LampRobot()
    port = PtyPort(lamp, link=tmp_path / "mesa")
    text = link("mesa", port.path, "lamp") + '[robots.LUZ]\nlink = "mesa"\n'
    async with lab(tmp_path, text, port) as made, made.listening("psiu/LUZ/*/light") as heard:
        answer = await made.call("LUZ", "light", 1)
        assert answer is not None
        assert answer.status == "sucesso"
        assert lamp.on
        answer = await made.call("LUZ", "state")
        assert answer is not None
        assert answer.values == [1]
        with pytest.raises(CallError, match="light takes 0 or 1"):
            await made.call("LUZ", "light", 2)
        assert [command.name for command in made.card("LUZ").commands] == ["light", "state"]
        port.send(b"0")
        await until(lambda: any(each.get("readings") == {"light": 0} for each in heard))


async def test_a_lamp_that_stays_dark_says_so(tmp_path: Path) -> None:
    port = PtyPort(LampRobot(broken=True), link=tmp_path / "mesa")
    async with lab(tmp_path, link("mesa", port.path, "lamp") + '[robots.LUZ]\nlink = "mesa"\n', port) as made:
        answer = await made.call("LUZ", "light", 1)
        assert answer is not None
        assert answer.status == "falha"


async def test_robots_of_words_switch_it(tmp_path: Path) -> None:
    lamp, robot = LampRobot(), AsciiRobot("BETA")
    mesa, radio = PtyPort(lamp, link=tmp_path / "mesa"), PtyPort(robot, link=tmp_path / "radio")
    text = link("mesa", mesa.path, "lamp") + link("radio", radio.path, "psiu-ascii") + '[robots.LUZ]\nlink = "mesa"\n'
    async with lab(tmp_path, text, mesa, radio):
        radio.send(message("LUZ", "light 1", "BETA"))
        await until(lambda: lamp.on)


def test_it_is_configured_as_any_other(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(f'[broker]\nname = "base"\n{CONFIGURATION}silence_ms = 50\n')
    with pytest.raises(ConfigurationError, match=r"robots.LUZ.silence_ms: unknown"):
        load(file)
    file.write_text(f'[broker]\nname = "base"\n{CONFIGURATION}')
    assert load(file).robots["LUZ"].protocol == "lamp"
    assert '"lamp"' in json.dumps(json_schema())


class TestCodec:
    def codec(self) -> Lamp:
        return Lamp(Lamp.Options(), Directory())

    @given(st.binary(), st.data())
    def test_however_the_stream_is_cut_every_byte_is_a_frame_or_noise(self, data: bytes, draw: st.DataObject) -> None:
        cut = draw.draw(st.integers(0, len(data)))
        whole, cut_up = self.codec(), self.codec()
        events = [*whole.decode(data, 0.0), *whole.flush(0.0)]
        assert [*cut_up.decode(data[:cut], 0.0), *cut_up.decode(data[cut:], 0.0), *cut_up.flush(0.0)] == events
        sizes = [each.size if isinstance(each, Malformed) else len(each.wire) for each in events]
        assert sum(sizes) == len(data)
        assert not whole.pending

    @given(st.binary())
    def test_only_what_a_lamp_knows_is_sent(self, payload: bytes) -> None:
        frame = Frame(NOBODY, NOBODY, "switch", payload, "lamp")
        if payload in (b"0", b"1", b"?"):
            assert self.codec().encode(frame) == payload
        else:
            with pytest.raises(EncodeError):
                self.codec().encode(frame)


def excerpts(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", CONTRIBUTING, re.MULTILINE | re.DOTALL)


def test_contributing_shows_these_files_and_this_entry() -> None:
    codec, profile, entry = excerpts("python")
    for shown, file in ((codec, "codec.py"), (profile, "profile.py")):
        text = (HERE / "lamp" / file).read_text()
        parts = re.split(r"^ *# …\n", shown, flags=re.MULTILINE)
        assert len(parts) > 1
        places = [text.find(part) for part in parts]
        assert -1 not in places
        assert places == sorted(places)
    assert entry == f'    "lamp": Protocol({ENTRY.codec.__name__}, {ENTRY.profile.__name__}),\n'
    assert excerpts("toml") == [CONFIGURATION.lstrip()]
