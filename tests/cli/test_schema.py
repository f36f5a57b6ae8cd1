"""The forms of the messages and of the configuration, for programs and editors."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path

from click.testing import Result
from jsonschema import Draft202012Validator

from psiu_broker.messages import PUBLISHED

Run = Callable[..., Result]

EXAMPLE = Path(__file__).parents[2] / "deploy/examples/psiu-broker.toml"


def test_every_message_has_a_schema_that_is_one(tool: Run) -> None:
    schemas = json.loads(tool("schema").stdout)
    assert list(schemas) == [message.__name__ for message in PUBLISHED]
    for schema in schemas.values():
        Draft202012Validator.check_schema(schema)


def test_one_message_is_told_by_its_name(tool: Run) -> None:
    schema = json.loads(tool("schema", "Answer").stdout)
    Draft202012Validator(schema).validate({"status": "sucesso", "values": [], "elapsed_ms": 2.5})
    assert not Draft202012Validator(schema).is_valid({"status": "talvez", "elapsed_ms": 2.5})


def test_an_unknown_message_is_refused_with_the_one_that_was_probably_meant(tool: Run) -> None:
    refused = tool("schema", "decode")
    assert refused.exit_code == 2
    assert "did you mean Decoded?" in refused.output


def test_the_schema_of_the_configuration_takes_the_example_and_refuses_a_wrong_key(daemon: Run) -> None:
    validator = Draft202012Validator(json.loads(daemon("schema").stdout))
    example = tomllib.loads(EXAMPLE.read_text())
    validator.validate(example)
    example["links"]["radio"]["bauds"] = 9600
    assert not validator.is_valid(example)
