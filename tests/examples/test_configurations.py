"""deploy/examples/protocols: files to copy from, which tell every option of their protocol, and its true default."""

import re
import tomllib
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Union, get_args, get_origin

import pytest
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo

from psiu_broker.config import Configuration, LinkOptions, load
from psiu_broker.config.tables import RobotTable
from psiu_broker.profiles.persona import PersonaOptions
from psiu_broker.protocols import PROTOCOLS

FOLDER = Path(__file__).parents[2] / "deploy/examples/protocols"
FILES = sorted(FOLDER.glob("*.toml"))
OF_PROTOCOL = {
    "psiu-ascii": "psiu-drafts.toml",
    "psiu-hexa": "psiu-hexa.toml",
    "mitya": "mitya.toml",
    "soccer": "soccer.toml",
    "firmata": "firmata.toml",
    "amarino": "amarino.toml",
}
TRANSLATIONS = "translations.toml"

EVERY_FILE = pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
SWITCHED_OFF = re.compile(r"^#(?=[a-z_]+ = |\[)", re.MULTILINE)
LINE = re.compile(r"(?P<off>#?)(?P<name>[a-z_]+) = (?P<value>.*?)\s+# (?P<comment>.*)")
HEADER = re.compile(r"#?\[{1,2}([\w.]+)\]{1,2}")

Models = dict[tuple[str, ...], type[BaseModel]]


class Told(NamedTuple):
    """An option with a comment, as a file tells it; `off`: behind a #, with its default."""

    table: tuple[str, ...]
    name: str
    value: object
    comment: str
    off: bool


def told(file: Path) -> Iterator[Told]:
    table: tuple[str, ...] = ()
    for line in file.read_text().splitlines():
        if (header := HEADER.match(line)) is not None:
            table = tuple(header[1].split("."))
        elif (option := LINE.fullmatch(line)) is not None:
            value = tomllib.loads(f"value = {option['value']}")["value"]
            yield Told(table, option["name"], value, option["comment"], bool(option["off"]))


def nested(model: type[BaseModel], at: tuple[str, ...]) -> Models:
    """`model` and the tables within it, by where they stand in a file; * stands for any name."""
    found: Models = {at: model}
    for name, field in model.model_fields.items():
        for inner, names in _tables(field.annotation):
            found |= nested(inner, (*at, name, *names))
    if issubclass(model, PersonaOptions):
        [rule] = [inner for inner, _ in _tables(_annotation(model))]
        found[*at, "*"] = rule
    return found


def _annotation(persona: type[PersonaOptions]) -> Any:
    for model in persona.__mro__:
        if "__pydantic_extra__" in vars(model).get("__annotations__", {}):
            return vars(model)["__annotations__"]["__pydantic_extra__"]
    raise AssertionError(f"{persona} takes no names")


def _tables(annotation: Any) -> Iterator[tuple[type[BaseModel], tuple[str, ...]]]:
    """The models that a value of this kind holds, and whether they are under names of the user's."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation, ()
    elif get_origin(annotation) in (Union, types.UnionType, tuple):
        for each in get_args(annotation):
            yield from _tables(each)
    elif get_origin(annotation) is dict:
        for model, names in _tables(get_args(annotation)[1]):
            yield model, ("*", *names)


def found_by(models: Models, table: tuple[str, ...]) -> tuple[str, ...] | None:
    for pattern in models:
        if len(pattern) == len(table) and all(part in ("*", name) for part, name in zip(pattern, table, strict=True)):
            return pattern
    return None


def tables_of(protocol: str) -> Models:
    each = PROTOCOLS[protocol]
    return {("links", "*"): each.codec.Options} | nested(each.profile.Options, ("robots", "*"))


def default_of(field: FieldInfo) -> object:
    return TypeAdapter(Any).dump_python(field.get_default(call_default_factory=True), mode="json")


def untold(models: Mapping[tuple[str, ...], type[BaseModel]], lines: list[Told]) -> set[tuple[str, ...]]:
    """The options of `models` that no line tells of; those that hold tables are told by these."""
    there = {(*pattern, line.name) for line in lines if (pattern := found_by(dict(models), line.table)) is not None}
    return {
        (*pattern, name)
        for pattern, model in models.items()
        for name, field in model.model_fields.items()
        if not any(True for _ in _tables(field.annotation))
    } - there


def test_every_protocol_has_a_file() -> None:
    assert set(OF_PROTOCOL) == set(PROTOCOLS)
    assert {file.name for file in FILES} == {*OF_PROTOCOL.values(), TRANSLATIONS}


@EVERY_FILE
def test_it_loads_without_a_warning_and_a_line_has_room_on_a_screen(file: Path) -> None:
    assert load(file).warnings == ()
    assert max(len(line) for line in file.read_text().splitlines()) <= 120


@EVERY_FILE
def test_what_is_switched_off_may_be_switched_on(file: Path, tmp_path: Path) -> None:
    on = tmp_path / file.name
    on.write_text(SWITCHED_OFF.sub("", file.read_text()))
    assert on.read_text() != file.read_text()
    load(on)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_option_of_the_protocol_is_told(protocol: str) -> None:
    lines = list(told(FOLDER / OF_PROTOCOL[protocol]))
    assert untold(tables_of(protocol), lines) == set()


@pytest.mark.parametrize(("protocol", "link"), [("mitya", "painel"), ("firmata", "placa"), ("amarino", "celular")])
def test_every_option_of_a_map_is_told(protocol: str, link: str) -> None:
    persona = PROTOCOLS[protocol].persona
    assert persona is not None
    lines = list(told(FOLDER / TRANSLATIONS))
    assert untold(nested(persona.Options, ("links", link, "map")), lines) == set()


def test_every_map_is_there() -> None:
    mapped = {link.protocol for link in load(FOLDER / TRANSLATIONS).links.values() if link.map is not None}
    assert mapped == {name for name, protocol in PROTOCOLS.items() if protocol.persona is not None}


@EVERY_FILE
def test_defaults_are_those_that_are_told(file: Path) -> None:
    configuration = load(file)
    checked = 0
    for line in told(file):
        field = field_of(line, configuration)
        if field is None:
            continue
        default = None if field.is_required() else default_of(field)
        _, _, claim = line.comment.rpartition("default: ")
        if field.is_required():
            assert line.comment.endswith("required"), line
        elif claim == line.comment:
            # Nothing is claimed: a line that is switched off shows it.
            assert not line.off or line.value == default, line
        elif default not in (None, [], {}):
            assert tomllib.loads(f"default = {claim}")["default"] == default, line
        checked += 1
    assert checked


def field_of(line: Told, configuration: Configuration) -> FieldInfo | None:
    """The option that a line tells of; None where it is none of a link's or a robot's."""
    kind, name = (*line.table, "", "")[:2]
    models: list[Models] = []
    if kind == "links":
        link = configuration.links[name]
        models = [{("links", "*"): model} for model in (LinkOptions, type(link.adapter), type(link.codec))]
        persona = PROTOCOLS[link.protocol].persona
        if persona is not None:
            models.append(nested(persona.Options, ("links", "*", "map")))
    elif kind == "robots":
        robot = configuration.robots[name]
        models = [{("robots", "*"): RobotTable}, nested(PROTOCOLS[robot.protocol].profile.Options, ("robots", "*"))]
    for each in models:
        pattern = found_by(each, line.table)
        if pattern is not None and line.name in each[pattern].model_fields:
            return each[pattern].model_fields[line.name]
    return None
