"""The policy that a configuration asks for."""

from collections.abc import Callable, Collection, Iterator
from typing import Final

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.config.tables import Configuration, LinkConfiguration
from psiu_broker.config.who import own_addresses
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.profiles.hexa import ACK, AVAILABLE, BUSY, FREE, NAK, WTF, HexaOptions, Node
from psiu_broker.profiles.psiu import COUNT, NAME, SHOW, canonical, said
from psiu_broker.routing.policy import Policy, Rule

_QUESTIONS: Final = frozenset({NAME, COUNT, SHOW})
_SIGNS: Final = frozenset({ACK, NAK, BUSY, AVAILABLE, FREE, WTF})
_ANSWER_BIT: Final = 0x80


def policy_of(configuration: Configuration, is_named: Callable[[Way], bool]) -> Policy:
    """Who may command whom, and what passes for a command.

    `is_named`: as `Transport.is_named`, of who is at a far end; asked of links whose adapter is exposed.
    """
    links = configuration.links.values()
    language = _Language(configuration)
    return Policy(
        tuple(_rules(configuration)),
        own_addresses(configuration),
        language.is_command,
        language.words,
        {link.name: _robots_of(configuration, link.name) for link in links if link.adapter.exposed},
        lambda way: not is_named(way),
    )


def _rules(configuration: Configuration) -> Iterator[Rule]:
    for position, rule in enumerate(configuration.policy):
        where = f"policy[{position}]"
        yield Rule(rule.action == "allow", rule.source, rule.destination, rule.command, rule.link, where)
    for link in configuration.links.values():
        yield from _rules_of(link)


def _rules_of(link: LinkConfiguration) -> Iterator[Rule]:
    here, options = (link.name,), link.options
    if options.deny:
        yield Rule(False, options.deny, link=here, where=f"links.{link.name}.deny")
    if options.allow is not None:
        where = f"links.{link.name}.allow"
        if options.allow:
            yield Rule(True, options.allow, link=here, where=where)
        yield Rule(False, link=here, where=where)


def _robots_of(configuration: Configuration, link: str) -> set[Address]:
    here = [robot for robot in configuration.robots.values() if robot.link == link]
    return {Address.named(robot.name) for robot in here} | {each.address for each in here if each.address is not None}


class _Language:
    """What frames mean as far as the policy goes; no method raises."""

    def __init__(self, configuration: Configuration) -> None:
        robots = configuration.robots.values()
        options = {robot.address: robot.options for robot in robots if isinstance(robot.options, HexaOptions)}
        self._nodes: dict[Address | None, dict[int, tuple[str, Node]]] = {
            address: {node.node: (name, node) for name, node in each.nodes.items()} for address, each in options.items()
        }
        self._marks_answers = {address for address, each in options.items() if each.sensor_reply == "bit7"}
        self._plays = {link.name for link in configuration.links.values() if link.options.plays is not None}

    def is_command(self, frame: Frame, arrived: Way) -> bool:
        """Whether `frame` may move its destination; in doubt it may.

        In protocols in which only programs command, all that they send does.
        """
        if frame.protocol == psiu_ascii.PROTOCOL:
            words = said(frame)
            return bool(words.command) and not words.answer and canonical(words.command) not in _QUESTIONS
        if frame.protocol == psiu_hexa.PROTOCOL:
            return self._is_order(frame)
        return arrived.link in self._plays

    def words(self, frame: Frame) -> Collection[str]:
        """What a rule may call the command of `frame`: its subject, and the name that the configuration gives it."""
        if frame.protocol == psiu_hexa.PROTOCOL and len(frame.payload) == 2:
            named = self._nodes.get(frame.destination, {}).get(frame.payload[0])
            return (frame.subject,) if named is None else (frame.subject, named[0])
        if frame.protocol == psiu_ascii.PROTOCOL and not frame.subject:
            return (said(frame).command,)
        return (frame.subject,)

    def _is_order(self, frame: Frame) -> bool:
        payload = frame.payload
        if len(payload) < 2:
            return len(payload) == 1 and payload[0] not in _SIGNS
        if len(payload) > 2:
            return True
        if payload[0] == 0 or (payload[0] & _ANSWER_BIT and frame.source in self._marks_answers):
            return False  # a sensor's answer
        named = self._nodes.get(frame.destination, {}).get(payload[0])
        return named is None or named[1].is_actuator
