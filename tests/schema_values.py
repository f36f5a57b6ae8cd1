"""Values that fit a JSON schema, of those that pydantic makes."""

from collections.abc import Mapping
from typing import Any, cast

from hypothesis import strategies as st

Schema = Mapping[str, Any]
Values = st.SearchStrategy[Any]


def values_of(schema: Schema) -> Values:
    """Values that `schema` allows, with few items where it allows many."""
    return _values(schema, schema.get("$defs", {}))


def _values(schema: Schema, named: Mapping[str, Schema]) -> Values:  # noqa: PLR0911
    if "$ref" in schema:
        return st.deferred(lambda: _values(named[schema["$ref"].rpartition("/")[2]], named))
    if "anyOf" in schema:
        return st.one_of([_values(each, named) for each in schema["anyOf"]])
    if "const" in schema:
        return st.just(schema["const"])
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    match schema.get("type"):
        case "object":
            return _object(schema, named)
        case "array":
            return _array(schema, named)
        case "string":
            return st.datetimes().map(lambda when: f"{when.isoformat()}Z") if "format" in schema else _text(schema)
        case "integer":
            return st.integers(
                schema.get("minimum"), schema.get("exclusiveMaximum", 1 + schema.get("maximum", 2**64)) - 1
            )
        case "number":
            least = schema.get("minimum", schema.get("exclusiveMinimum"))
            return st.floats(
                least, schema.get("maximum"), exclude_min="exclusiveMinimum" in schema,
                allow_nan=False, allow_infinity=False,
            )  # fmt: skip
        case "boolean":
            return st.booleans()
        case "null":
            return st.none()
        case unknown:
            assert unknown is None, f"no values are known of type {unknown}"
            return st.integers() | st.text(max_size=5) | st.none()


def _text(schema: Schema) -> Values:
    most = schema.get("maxLength", 40)
    if "pattern" in schema:
        return st.from_regex(schema["pattern"].replace("$", r"\Z")).filter(lambda text: len(text) <= most)
    return st.text(min_size=schema.get("minLength", 0), max_size=min(most, 40))


def _array(schema: Schema, named: Mapping[str, Schema]) -> Values:
    if "prefixItems" in schema:
        return st.tuples(*(_values(each, named) for each in schema["prefixItems"])).map(list)
    most = min(schema.get("maxItems", 5), 5)
    return st.lists(_values(schema.get("items", {}), named), min_size=schema.get("minItems", 0), max_size=most)


def _object(schema: Schema, named: Mapping[str, Schema]) -> Values:
    properties = {name: _values(each, named) for name, each in schema.get("properties", {}).items()}
    required = schema.get("required", [])
    known = st.fixed_dictionaries(
        {name: properties[name] for name in required},
        optional={name: each for name, each in properties.items() if name not in required},
    )
    more = schema.get("additionalProperties", False)
    if not isinstance(more, Mapping):
        return known
    keys = st.integers(0, 9).map(str) if "patternProperties" in schema else st.text(max_size=8)
    others = st.dictionaries(keys, _values(cast(Schema, more), named), max_size=3)
    return st.builds(lambda rest, own: rest | own, others, known)
