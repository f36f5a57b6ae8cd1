"""One line for a person from each message of the bus. Read as plain JSON, so that a newer broker's words pass."""

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from psiu_broker.cli.output import printable, styled

Message = Mapping[str, Any]

_COLOURS = {"sucesso": "green", "falha": "red"}


def frame_words(message: Message) -> str:
    """What a `Decoded` says: ``parafrente 100``, ``garra 45 deg (node 4, signal 64)``, ``battery=5.02 V``, ``ack``."""
    kind = str(message.get("kind"))
    words: list[object] = [message.get("command") or kind]
    readings = message.get("readings") or {}
    parameters = [*(message.get("parameters") or ())]
    if kind == "node":
        node, signal = message.get("node"), message.get("signal")
        if message.get("command") is None:
            words = ["node", node, "signal", signal]
        elif message.get("value") is not None:
            words += [f"{message['value']:g}", message.get("unit") or "", f"(node {node}, signal {signal})"]
        else:
            words += [f"(node {node}, signal {signal})"]
    elif readings:
        names = list(readings)
        # A reading that is called like the message, or that its parameters repeat, is said once.
        words = [] if names == words else words
        parameters = []
        words += [f"{name}={value}" for name, value in readings.items()]
        words.append(message.get("unit") or "")
    elif parameters:
        parameters.append(message.get("unit") or "")
    elif message.get("value") is not None:
        words += [f"{message['value']:g}", message.get("unit") or ""]
    words += [message.get("status") or "", *parameters, *(message.get("fields") or ())]
    text = " ".join(str(word) for word in words if word != "")
    return f"{text} [{message['remark']}]" if message.get("remark") else text


def frame_line(message: Message) -> str:
    """A `Decoded`: when, who to whom, what, and on which link."""
    words = styled(frame_words(message), fg=_COLOURS.get(str(message.get("status"))), bold=True)
    return f"{_when(message)}  {_pair(message)}  {words}  {_dim(message.get('link'))}"


def raw_line(message: Message) -> str:
    """A `RawFrame`: when, in or out, on which link, what became of it, and its bytes."""
    place = "/".join(str(message[part]) for part in ("link", "peer") if message.get(part))
    verdict = str(message.get("verdict"))
    detail = f" ({message['detail']})" if message.get("detail") else ""
    who = f"{_pair(message)}  {message.get('subject')}  " if message.get("source") is not None else ""
    colour = {"delivered": "green", "answered": "green"}.get(verdict, "red")
    told = styled(verdict + detail, fg=colour)
    return (
        f"{_when(message)}  {printable(place)} {message.get('direction')}  {printable(who)}{told}"
        f"  {_dim(message.get('wire'))}"
    )


def card_line(message: Message) -> str:
    """A `Card`: the robot, where it is and how much it can do."""
    heard = "never heard" if message.get("last_heard") is None else f"{message.get('frames_heard')} frames heard"
    commands = len(message.get("commands") or ())
    text = (
        f"{message.get('robot')} is on {message.get('link')} ({message.get('link_state')}), {message.get('protocol')},"
        f" {heard}, {commands} commands"
    )
    return f"{_clock(datetime.now())}  {_dim(printable(text))}"


def gone_line(robot: str) -> str:
    return f"{_clock(datetime.now())}  {_dim(printable(f'{robot} is gone'))}"


def _pair(message: Message) -> str:
    return printable(f"{message.get('source') or '?'} → {message.get('destination') or '?'}")


def _when(message: Message) -> str:
    try:
        return _clock(datetime.fromisoformat(str(message.get("received"))).astimezone())
    except ValueError:
        return "--:--:--.---"


def _clock(moment: datetime) -> str:
    return f"{moment:%H:%M:%S}.{moment.microsecond // 1000:03d}"


def _dim(text: object) -> str:
    return styled(str(text), dim=True)
