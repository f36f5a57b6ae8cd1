"""The file as a whole: what is no TOML or no key, and what is told of it."""

import json
import tomllib
from pathlib import Path
from textwrap import dedent

import jsonschema
import pytest
from config.texts import (
    AS_IN_THE_README,
    HILL,
    VALLEY,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from psiu_broker.config import json_schema, load
from psiu_broker.errors import ConfigurationError
from psiu_broker.frame import Address

EXAMPLE = Path(__file__).parents[2] / "deploy/examples/psiu-broker.toml"


def test_the_configuration_of_the_readme_loads_as_written(read):
    configuration = read(AS_IN_THE_README)
    assert configuration.broker.name == "base"
    assert configuration.broker.address == 0
    assert configuration.zenoh.listen == ("tcp/127.0.0.1:7447",)
    assert configuration.zenoh.prefix == "psiu"
    assert configuration.warnings == ()
    radio, wifi, arm = configuration.links.values()
    assert (radio.name, radio.adapter_name, radio.protocol) == ("radio", "serial", "psiu-ascii")
    assert radio.adapter.model_dump()["baudrate"] == 9600
    assert wifi.adapter.model_dump()["peers"] == ("127.0.0.1:9001",)
    assert arm.adapter.model_dump()["address"] == "98:D3:31:00:00:01"
    assert (arm.options.queue_frames, arm.options.max_age_s, arm.options.nak) == (64, 2.0, None)
    robot = configuration.robots["BRACO"]
    assert (robot.name, robot.link, robot.protocol) == ("BRACO", "arm", "psiu-hexa")
    assert robot.address == Address.numbered(0x12)
    assert (robot.options.nodes["garra"].node, robot.options.nodes["garra"].type) == (4, "servo")


def test_a_configuration_cannot_be_changed(read):
    configuration = read(AS_IN_THE_README)
    for thing, field in [
        (configuration, "broker"),
        (configuration.broker, "name"),
        (configuration.links["radio"], "name"),
        (configuration.links["radio"].options, "retries"),
        (configuration.robots["BRACO"], "link"),
    ]:
        with pytest.raises((AttributeError, ValueError)):
            setattr(thing, field, "other")


def test_every_mistake_is_told_at_once(problems):
    lines = problems(
        """
        [brokr]
        [broker]
        name = "??"
        [zenoh]
        listen = [1]
        [links.radio]
        adapter = "serial"
        baudrate = "9600"
        baudrat = 1
        protocol = "psiu-asci"
        retries = -1
        [links.wifi]
        adapter = "udp"
        listen = "127.0.0.1:9000"
        protocol = "psiu-ascii"
        strictt = true
        [robots.A]
        link = "wifii"
        adress = 1
        """
    )
    assert [line.partition(": ")[0] for line in lines] == [
        "brokr",
        "broker.name",
        "zenoh.listen[0]",
        "links.radio.protocol",
        "links.radio.retries",
        "links.radio.device",
        "links.radio.baudrate",
        "links.wifi.strictt",
        "robots.A.link",
        "robots.A.adress",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[links.a]\ndevice = /dev/ttyUSB0", "radio.toml:2:10: not TOML: Invalid value; text is written in quotes"),
        ("[broker]\nname = 'a'\nname = 'b'\n", "radio.toml:3:11: not TOML: Cannot overwrite a value"),
        ("name = ", "radio.toml: at the end: not TOML: Invalid value"),
        ("a = " + "9" * 5000, "radio.toml: not TOML: "),
        ("a = " + "[" * 5000 + "]" * 5000, "radio.toml: "),
        ("[broker" + ".a" * 5000 + "]", "radio.toml: "),
    ],
)
def test_what_is_not_toml_is_told_with_line_and_column(read, text, expected):
    with pytest.raises(ConfigurationError) as caught:
        read(text)
    (line,) = caught.value.problems
    assert line.startswith(expected)


def test_a_file_that_cannot_be_read_is_told_in_one_line(tmp_path):
    (tmp_path / "latin1.toml").write_bytes("name = 'José'".encode("latin-1"))
    for name, expected in {
        "missing.toml": "cannot be read: No such file or directory",
        ".": "cannot be read: Is a directory",
        "latin1.toml": "byte 11 is not UTF-8",
    }.items():
        with pytest.raises(ConfigurationError) as caught:
            load(tmp_path / name)
        (line,) = caught.value.problems
        assert line.startswith(f"{tmp_path / name}: {expected}")


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path):
    path = tmp_path / "windows.toml"
    path.write_bytes(b"\xef\xbb\xbf" + dedent(AS_IN_THE_README).replace("\n", "\r\n").encode())
    assert load(path).broker.name == "base"


def test_the_schema_accepts_the_readme_s_configuration_and_refuses_what_loading_refuses():
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    check = jsonschema.Draft202012Validator(json.loads(json.dumps(schema)))
    good = tomllib.loads(dedent(AS_IN_THE_README + HILL + VALLEY))
    check.validate(good)
    check.validate(tomllib.loads(EXAMPLE.read_text()))
    for path, value in {
        ("links", "radio", "baudrat"): 9600,
        ("links", "radio", "topology"): "ad-hoc",
        ("links", "radio", "adapter"): "seral",
        ("links", "wifi", "baudrate"): 9600,
        ("robots", "BRACO", "nodes", "garra", "type"): "srvo",
        ("trunks", "hill", "adapter"): "udp",
        ("trunks", "hill", "protocol"): "psiu-ascii",
        ("broker", "address"): 256,
        ("other",): 1,
        ("zenoh", "listen"): [],
    }.items():
        bad = json.loads(json.dumps(good))
        table = bad
        for part in path[:-1]:
            table = table[part]
        table[path[-1]] = value
        assert not check.is_valid(bad), path


values = st.recursive(
    st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=20)
    | st.sampled_from(["serial", "psiu-hexa", "radio"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=5,
)
KEYS = [
    "adapter",
    "protocol",
    "device",
    "baudrate",
    "peers",
    "listen",
    "address",
    "link",
    "nodes",
    "topology",
    "remote",
]


def toml(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return json.dumps(value).replace("\\u007f", "\\u007F").replace("\x7f", "\\u007F")
        case list():
            return "[" + ", ".join(map(toml, value)) + "]"
        case dict():
            return "{" + ", ".join(f"{toml(key)} = {toml(inner)}" for key, inner in value.items()) + "}"
        case _:
            return repr(value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.sampled_from(["broker", "zenoh", "links", "trunks", "robots"]),
        values
        | st.dictionaries(st.sampled_from(["radio", "name", "A"]), st.dictionaries(st.sampled_from(KEYS), values)),
    )
)
def test_whatever_the_file_says_the_author_gets_whole_lines_and_never_a_traceback(tmp_path, tables):
    path = tmp_path / "radio.toml"
    path.write_text("\n".join(f"{name} = {toml(value)}" for name, value in tables.items()), encoding="utf-8")
    try:
        load(path)
    except ConfigurationError as error:
        assert error.problems
        for line in error.problems:
            assert line.startswith(str(path))
            assert line.splitlines() == [line]
