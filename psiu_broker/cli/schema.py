"""`psiu schema`: what the messages on the bus look like."""

from difflib import get_close_matches

import click

from psiu_broker.cli.commands import examples
from psiu_broker.cli.output import print_json
from psiu_broker.messages import PUBLISHED


@click.command(epilog=examples("psiu schema", "psiu schema Decoded", "psiu schema Answer > answer.schema.json"))
@click.argument("name", required=False)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, as without it.")
def schema(name: str | None, as_json: bool) -> None:
    """Print the JSON schema of the message NAME, or an object with the schemas of all, by name."""
    schemas = {message.__name__: message.model_json_schema() for message in PUBLISHED}
    if name is not None and name not in schemas:
        near = get_close_matches(name.title(), schemas, n=1)
        known = f"did you mean {near[0]}?" if near else f"known: {', '.join(schemas)}"
        raise click.UsageError(f"there is no message {name!r}; {known}")
    print_json(schemas if name is None else schemas[name])
