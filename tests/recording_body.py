"""The body of a Robot Mitya as far as it records scripts, on a clock that jumps, for tests of calls."""

import asyncio
from collections.abc import Sequence
from typing import Any

from scripted_robots import BASE, Robots

from psiu_broker.codecs.mitya import PROTOCOL, Mitya, Version, word_of
from psiu_broker.conversation import Robot
from psiu_broker.frame import Address, Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.profile import Request
from psiu_broker.profiles.roboscript import ScriptedMitya

MITYA = Address.named("MITYA")


class Body:
    """Records and does what it hears, with memory for `room` actions; messages of numbers in `deaf` are lost."""

    def __init__(self, robots: Robots, version: Version = "2012", room: int = 130) -> None:
        self.slots: dict[int, list[tuple[str, str]]] = {}
        self.done: list[str] = []
        self.heard: list[str] = []
        self.deaf: set[int] = set()
        self.recording: int | None = None
        self.object_at: int | None = None
        """It cannot read the message of this number."""
        self.robots = robots
        self.profile = ScriptedMitya(Mitya.Options(version=version))
        self._version = version
        self._room = room
        self._made: dict[int, int] = {}
        self._begun: str | None = None
        robots.script = self._hear
        robots._links[MITYA] = "corpo"

    @property
    def robot(self) -> Robot:
        return Robot("MITYA", BASE, MITYA, self.profile, self._build, "corpo")

    async def call(self, command: str, *parameters: Value, **more: Any) -> Answer:
        return await self.robots.conversations.call(self.robot, command, parameters, **more)

    def _build(self, request: Request) -> Frame:
        return Frame(BASE, MITYA, request.subject, request.payload, PROTOCOL)

    def _hear(self, frame: Frame) -> Sequence[tuple[float, bytes]]:
        text = frame.payload.decode()
        self.heard.append(text)
        number = len(self.heard)
        if number in self.deaf:
            return ()
        for said in self._object("E0001") if number == self.object_at else self._take(text[0], text[1:]):
            payload = said.replace("E", "#").encode() if self._version == "2013" else said.encode()
            answer = Frame(MITYA, BASE, word_of(self._version, payload), payload, PROTOCOL)
            asyncio.get_running_loop().call_later(0.02, self.robots.say, answer)
        return ()

    def _take(self, letter: str, value: str) -> Sequence[str]:
        if self.recording is not None:
            return self._record(letter, value)
        if letter in "WZ":
            return ("E0007",)
        if letter == "r" and value.startswith("01"):
            self.recording = int(value[2:], 16)
        elif letter != "r" or value.startswith("00"):
            self.done.append(letter + value)
        return () if self._version == "2012" else ("#0000",)

    def _record(self, letter: str, value: str) -> Sequence[str]:
        assert self.recording is not None
        actions = self.slots.setdefault(self.recording, [])
        if letter == "Z" and value == "0000":
            if self._begun is not None:
                return self._object("E0004")
            self.recording = None
            return ("r0200",)
        if letter == "Z":
            actions.clear()
            self._made[self.recording] = int(value, 16)
            return self._object("E0005") if int(value, 16) > self._room else ()
        if letter == "r":
            return self._object("E0003")
        if letter != "W" and self._begun is None:
            self._begun = letter + value
            return ()
        if letter != "W" or self._begun is None:
            return self._object("E0004")
        if len(actions) == self._made.get(self.recording, 0):
            return self._object("E0006")
        actions.append((self._begun, value))
        self._begun = None
        return ()

    def _object(self, error: str) -> Sequence[str]:
        if self.recording is None:
            return (error,)
        self.slots[self.recording] = []
        self._made[self.recording] = 0
        self.recording = self._begun = None
        return error, "r0200"
