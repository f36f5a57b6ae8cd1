"""What is wrong with the file, in lines for its author.

FILE: KEY: what was expected, what was got; what to do.
"""

import json
import re
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

Key = tuple[str | int, ...]
"""Where in the file: ``("links", "radio", "peers", 0)``."""

Table = TypeVar("Table", bound=BaseModel)


class Problems:
    """Collects every mistake of one file; `lines` are what the user reads."""

    def __init__(self, file: str) -> None:
        self.lines: list[str] = []
        self._file = file

    def add(self, key: Key, text: str) -> None:
        """Note one mistake at `key`; () means the file as a whole."""
        where = f"{self._file}: {spelled(key)}" if key else self._file
        self.lines.append(one_line(f"{where}: {text}"))

    def unknown(self, key: Key, known: Collection[str]) -> None:
        """Note a key that means nothing here, with the one of `known` that was probably meant."""
        self.add(key, f"unknown key; {suggestion(str(key[-1]), known)}")

    def table(self, value: object, key: Key) -> dict[str, Any] | None:
        """`value` if it is a table; else None, and the mistake is noted."""
        if isinstance(value, dict):
            return value
        self.add(key, f"expected a table, got {got(value)}; write [{spelled(key)}] above its keys")
        return None

    def read(self, model: type[Table], value: object, key: Key) -> Table | None:
        """The table at `key` as `model`, nothing coerced; None when it is not one, and every mistake is noted."""
        table = self.table(value, key)
        if table is None:
            return None
        try:
            return model.model_validate_json(json.dumps(table, default=_no_text), strict=True)
        except ValidationError as error:
            for at, text in _explained(error, model, table):
                self.add((*key, *at), text)
            return None


def suggestion(word: str, known: Collection[str]) -> str:
    """What to say to somebody who wrote `word` where only one of `known` will do."""
    return guess(word, known) or (f"known: {', '.join(sorted(known))}" if known else "nothing may be written here")


def guess(word: str, known: Collection[str]) -> str:
    """A question for which of `known` was meant by `word`; "" where none is near."""
    folded = {name.lower(): name for name in known}
    near = get_close_matches(word.lower(), folded, n=1)
    return f"did you mean {folded[near[0]]}?" if near else ""


def spelled(key: Key) -> str:
    """`key` as TOML spells it, list positions in brackets: ``links.wifi.peers[0]``."""
    text = ""
    for part in key:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            bare = re.fullmatch(r"[A-Za-z0-9_-]+", part)
            text += ("." if text else "") + (part if bare else _quoted(part))
    return text


def got(value: object) -> str:
    """`value` as its author wrote it, cut where it is long."""
    match value:
        case bool():
            return str(value).lower()
        case str():
            return _quoted(value if len(value) <= 60 else value[:59] + "…")
        case list():
            return f"a list of {len(value)}"
        case dict():
            return "a table"
        case _:
            return str(value)


def one_line(text: str) -> str:
    """`text` with every run of white space made one space."""
    return " ".join(text.split())


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=not text.isprintable())


def _no_text(_: object) -> dict[str, Any]:
    # TOML's dates have no JSON form, and as text they would pass for one where text is expected.
    return {}


def _explained(error: ValidationError, model: type[BaseModel], table: Mapping[str, Any]) -> Iterator[tuple[Key, str]]:
    """Each mistake once: where in `table`, and its text. The branches of a union become one mistake."""
    schema = model.model_json_schema()
    expected: dict[Key, list[str]] = {}
    for detail in error.errors(include_url=False):
        at = _within(table, detail["loc"], missing=detail["type"] in {"missing", "extra_forbidden"})
        message = detail["msg"]
        if detail["type"] == "extra_forbidden":
            yield at, f"unknown key; {suggestion(str(at[-1]), _part(schema, at[:-1]).get('properties', {}))}"
        elif detail["type"] == "missing":
            about = _part(schema, at).get("description")
            yield at, f"missing; write {spelled(at[-1:])} = …" + (f" ({about})" if about else "")
        elif detail["type"] in {"value_error", "assertion_error"}:
            yield at, message.partition(", ")[2] or message
        elif message.startswith("Input should be "):
            expected.setdefault(at, []).append(_in_words(message.removeprefix("Input should be ")))
        else:
            yield at, f"{message[0].lower()}{message[1:]}, got {got(_value(table, at))}"
    for at, wanted in expected.items():
        value = _value(table, at)
        yield at, f"expected {' or '.join(dict.fromkeys(wanted))}, got {got(value)}{_remedy(value, wanted)}"


def _in_words(wanted: str) -> str:
    """pydantic's name for a kind of value in TOML's words; a range becomes a number in it."""
    kind = wanted.removeprefix("a valid ").removeprefix("an ").removeprefix("a ")
    return _KINDS.get(kind) or (f"a number {wanted}" if wanted.startswith(("greater", "less")) else wanted)


def _within(table: Mapping[str, Any], loc: Key, *, missing: bool) -> Key:
    """The part of `loc` that is in `table`: pydantic appends the branch of a union to it."""
    value: Any = table
    for depth, part in enumerate(loc):
        inside = isinstance(value, Mapping) and part in value
        if isinstance(value, list) and isinstance(part, int) and part < len(value):
            inside = True
        if not inside:
            return loc if missing and depth == len(loc) - 1 else loc[:depth]
        value = value[part]
    return loc


def _value(table: Mapping[str, Any], at: Key) -> object:
    value: Any = table
    for part in at:
        value = value[part]
    return value


def _part(schema: dict[str, Any], at: Key) -> dict[str, Any]:
    """What the JSON schema says of the value at `at`; {} where it says nothing."""
    part = _resolved(schema, schema)
    for step in at:
        inner = part.get("items") if isinstance(step, int) else part.get("properties", {}).get(step)
        inner = part.get("additionalProperties") if inner is None else inner
        part = _resolved(inner, schema) if isinstance(inner, dict) else {}
    return part


def _resolved(part: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """`part` with its reference followed; of an optional one, the branch that is not null."""
    for branch in part.get("anyOf", []):
        if branch.get("type") != "null":
            return {**_resolved(branch, schema), **part}
    if "$ref" in part:
        defined: dict[str, Any] = schema["$defs"][part["$ref"].rpartition("/")[2]]
        return {**defined, **part}
    return part


def _remedy(value: object, wanted: Collection[str]) -> str:
    """What to write instead, where `value` tells what was meant."""
    kinds = " ".join(wanted)
    if isinstance(value, bool | list | dict) or value is None:
        return ""
    if isinstance(value, str):
        if re.search("number|true or false", kinds) and _BARE.fullmatch(value):
            return f"; write it without quotes: {value}"
        if question := guess(value, re.findall("'([^']*)'", kinds)):
            return f"; {question}"
    elif "text" in kinds or f"'{value}'" in kinds:
        return f'; write it in quotes: "{value}"'
    return f"; write it in brackets: [{got(value)}]" if "a list" in kinds else ""


_KINDS = {
    "integer": "a whole number",
    "number": "a number",
    "finite number": "a finite number",
    "boolean": "true or false",
    "string": "text",
    "array": "a list",
    "list": "a list",
    "tuple": "a list",
    "object": "a table",
    "dictionary": "a table",
}
_BARE = re.compile(r"[+-]?(0x[0-9A-Fa-f]+|[0-9]+(\.[0-9]+)?)|true|false")
