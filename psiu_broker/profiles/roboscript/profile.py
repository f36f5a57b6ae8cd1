"""Robot Mitya with its scripts."""

from collections.abc import Sequence

from psiu_broker.codecs import mitya
from psiu_broker.codecs.mitya import Version
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.mitya import MityaProfile, meaning
from psiu_broker.profiles.profile import Reading, Request
from psiu_broker.profiles.roboscript import recording
from psiu_broker.profiles.roboscript.script import Vocabulary


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

    def commands(self) -> Sequence[Command]:
        return [*super().commands(), *(recording.COMMANDS if self.vocabulary.forms else ())]

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        if command == recording.UPLOAD:
            request = recording.upload(parameters, self.vocabulary, datagrams=self._datagrams)
        elif command == recording.ABORT:
            request = recording.abort(parameters, self.vocabulary)
        else:
            return super().request(command, parameters)
        if self._realigner is not None:
            self._realigner.forget()
        return request

    def read(self, request: Request, frame: Frame) -> Reading | None:
        if request.procedure is None:
            return super().read(request, frame)
        asked = self._realigner is not None and self._realigner.took(frame)
        if asked and mitya.number(frame.payload) == _NOT_RECORDING:
            return None  # to the W0000 of a greeting
        return recording.heard(frame, meaning)


def vocabulary(version: Version) -> Vocabulary:
    """What can be an action of a robot of which no more is known than its version."""
    return ScriptedMitya(mitya.Mitya.Options(version=version)).vocabulary


_NOT_RECORDING = 0x07
