"""Robot Mitya with its scripts."""

from collections.abc import Sequence

from psiu_broker.codecs import mitya
from psiu_broker.codecs.mitya import STOP, Version
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.mitya import MityaProfile, meaning
from psiu_broker.profiles.profile import Reading, Reply, Request
from psiu_broker.profiles.roboscript import playback, recording
from psiu_broker.profiles.roboscript.script import RECORD, Vocabulary


class ScriptedMitya(MityaProfile):
    """A Robot Mitya that can be sent scripts; its actions are its commands, those of the configuration too."""

    def __init__(
        self,
        codec: mitya.Mitya.Options | None = None,
        robot: MityaProfile.Options | None = None,
        timeout_s: float = 2.0,
        *,
        datagrams: bool = False,
    ) -> None:
        """As `MityaProfile`."""
        super().__init__(codec, robot, timeout_s, datagrams=datagrams)
        self.vocabulary = Vocabulary(self.version, self._forms)
        self._datagrams = datagrams
        self._playback = playback.Playback(self.version, datagrams=datagrams)

    def commands(self) -> Sequence[Command]:
        return [*super().commands(), *(recording.COMMANDS if self.vocabulary.forms else ())]

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        if command == recording.UPLOAD:
            request = recording.upload(parameters, self.vocabulary, datagrams=self._datagrams)
        elif command == recording.ABORT:
            request = recording.abort(parameters, self.vocabulary)
        else:
            return self._following(super().request(command, parameters))
        if self._realigner is not None:
            self._realigner.forget()
        return request

    def read(self, request: Request, frame: Frame) -> Reading | None:
        if request.procedure is None:
            reading = super().read(request, frame)
            return _telling_loss(reading, request) if isinstance(reading, Reply) else reading
        asked = self._realigner is not None and self._realigner.took(frame)
        if asked and mitya.number(frame.payload) == _NOT_RECORDING:
            return None  # to the W0000 of a greeting
        return recording.heard(frame, meaning)

    def learn(self, frame: Frame) -> bool:
        self._playback.heard(frame)
        return super().learn(frame)

    def _following(self, request: Request) -> Request:
        """`request`, with what a stop needs where a script may be played."""
        if request.subject == RECORD:
            self._playback.begins(mitya.number(request.payload))
        if request.subject != STOP:
            return request
        request = request._replace(payload=self._playback.stop())
        return request._replace(silence=request.silence and _telling_loss(request.silence, request))


def vocabulary(version: Version) -> Vocabulary:
    """What can be an action of a robot of which no more is known than its version."""
    return ScriptedMitya(mitya.Mitya.Options(version=version)).vocabulary


def _telling_loss(reply: Reply, request: Request) -> Reply:
    slot = playback.lost(request.payload) if request.subject == STOP else None
    if slot is None:
        return reply
    loss = f"the script of slot {slot} was lost to the stop: upload it again"
    return reply._replace(remark=f"{reply.remark}; {loss}" if reply.remark else loss)


_NOT_RECORDING = 0x07
