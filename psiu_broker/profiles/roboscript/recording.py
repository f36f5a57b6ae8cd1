"""How a Robot Mitya is told to record a script, to play one, and to end a recording that was left open. Pure.

A recording is a procedure: the body takes all that it hears for the script, until it has said ``r0200``.
"""

from collections.abc import Callable, Sequence
from typing import Final

from psiu_broker.codecs.mitya import BY_WORD, SCRIPT, Version, is_message, message, number
from psiu_broker.errors import CallError
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.profile import Procedure, Reply, Request, Step
from psiu_broker.profiles.roboscript.reading import no_roboscript, read
from psiu_broker.profiles.roboscript.script import RECORD, ROOM, SLOTS, WAIT, Message, Script, Vocabulary, compiled

UPLOAD: Final = "roboscript-upload"
ABORT: Final = "roboscript-abort"

COMMANDS: Final = (
    Command(name=UPLOAD, ints=1, chars=1, description="record a script, its text, in a slot 0 to 9"),
    Command(name=ABORT, description="end a recording, also one that was left open"),
)

PAUSE_S: Final = 0.05
"""After each message: longer than a body at 9600 baud, behind a USB adapter, takes to object. What is sent between
its objection and our hearing of it is done at once instead of recorded."""
RELAYED_PAUSE_S: Final = 0.15
"""The same where a phone relays, by WiFi and Bluetooth."""
FIRST_PAUSES: Final = 5
"""r01xx and Zxxxx have so many times as long: to them a body objects that is out of step or has no room."""
END_S: Final = 2.0
"""How long a body may take to say that it has ended the recording."""
RELAYED: Final = Reply(None, remark="sent; the phone passes on only what goes wrong, and nothing did")
"""What silence means where a phone relays."""


def upload(parameters: Sequence[Value], vocabulary: Vocabulary, *, datagrams: bool = False) -> Request:
    """A call with a slot and the text of a script.

    Raises:
        CallError: refused; each problem of a script is a line that begins with ``line N:``.
    """
    _refuse_without(vocabulary)
    match list(parameters):
        case [int(slot), str(text)] if 0 <= slot < SLOTS:
            return _upload(slot, read(text, vocabulary), vocabulary.version, datagrams=datagrams)
        case [slot, str()]:
            raise CallError("refused", f"a slot is 0 to {SLOTS - 1}, got {slot}")
        case _:
            raise CallError("refused", f"{UPLOAD} takes a slot and the text of a script, got {len(parameters)} values")


def abort(parameters: Sequence[Value], vocabulary: Vocabulary) -> Request:
    """A call that ends whatever the body records.

    Raises:
        CallError: refused.
    """
    _refuse_without(vocabulary)
    if parameters:
        raise CallError("refused", f"{ABORT} takes no parameters, got {len(parameters)}")
    ended = "it records no longer; a script that it was recording is lost"
    return Request(ABORT, b"", False, END_S, procedure=Procedure((), _ending(vocabulary.version), ended))


def heard(frame: Frame, meaning: Callable[[int], str]) -> Reply | None:
    """What a body's message says of a recording: that it has ended, and how; None for anything else.

    `meaning` are the errors in words. E01xx come from the phone, which does not record.
    """
    if not is_message(frame.payload):
        return None
    value = number(frame.payload)
    if frame.subject == RECORD and value >> 8 == 2:
        return Reply("sucesso")
    if frame.subject == "error" and 0 < value < 0x100:
        code = frame.payload.decode("ascii", "replace")
        return Reply("falha", (code,), remark=f"{code}, {meaning(value)}")
    return None


def _upload(slot: int, script: Script, version: Version, *, datagrams: bool) -> Request:
    if script.problems:
        lines = (f"line {each.line}: {each.text}" if each.line else each.text for each in script.problems)
        raise CallError("refused", "\n".join(lines))
    sent = compiled(script.actions, slot, version)
    pause_s = RELAYED_PAUSE_S if datagrams else PAUSE_S
    steps = [_step(each, pause_s) for each in sent]
    for first in (0, 1):
        steps[first] = steps[first]._replace(pause_s=FIRST_PAUSES * pause_s)
    steps[0] = steps[0]._replace(subject=RECORD)  # it is done, not recorded
    steps[-1] = steps[-1]._replace(pause_s=END_S)
    ended = f"it records no longer; upload slot {slot} again before it is played"
    procedure = Procedure(tuple(steps), _ending(version), ended)
    return Request(UPLOAD, b"", False, END_S, RELAYED if datagrams else None, procedure)


def _step(sent: Message, pause_s: float) -> Step:
    wire = sent.wire.decode("ascii")
    name = f"line {sent.line}: {sent.word} ({wire})" if sent.line else wire
    return Step(SCRIPT + sent.word, sent.wire, name, sent.line, pause_s)


def _ending(version: Version) -> tuple[Step, ...]:
    """Ends a recording and empties its slot, wherever the body is in it, and lets no motor run.

    Of two delays in a row one at least has no command before it: then a body ends the recording with an error and
    frees the slot, where Z0000 would leave half a script to be played. Outside a recording they are only refused.
    Should one of them be lost, Z0000 ends it. What was sent after an error was done, and is undone by the stop.
    """
    letters = BY_WORD[version]
    delay, end, stop = (message(letters[word], 0) for word in (WAIT, ROOM, "drive"))
    return (
        Step(WAIT, delay, "end"),
        Step(WAIT, delay, "end"),
        Step(ROOM, end, "end"),
        Step("drive", stop, "end"),
    )


def _refuse_without(vocabulary: Vocabulary) -> None:
    if not vocabulary.forms:
        raise CallError("refused", no_roboscript(vocabulary))
