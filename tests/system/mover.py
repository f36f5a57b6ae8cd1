"""A program in plain Zenoh that moves a robot, in a process of its own: python -m tests.system.mover ENDPOINT HOW

It shows its token, calls ``MNERIM parafrente 100`` (put: without waiting for an answer), prints a line, and then waits
to be killed; with ``done`` it goes in good order once its stdin ends, with ``nameless`` nobody knows it. With
``client`` it is a program that uses `psiu_broker.bus.client`, as the `psiu` tool does.
"""

import json
import sys

import zenoh

from psiu_broker.bus.client import Client
from psiu_broker.messages import CallRequest

ID = "painel"


def main() -> None:
    endpoint, *how = sys.argv[1:]
    if "client" in how:
        with Client([endpoint]) as client:
            client.call("MNERIM", "parafrente", CallRequest(parameters=[100]))
            print("moved", flush=True)
            sys.stdin.read()
    else:
        _plainly(endpoint, how)


def _plainly(endpoint: str, how: list[str]) -> None:
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": 5000, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        if "nameless" not in how:
            token = session.liveliness().declare_token(f"psiu/@program/{ID}")  # noqa: F841 - there for as long as we are
        request = {"parameters": [100]} | ({} if "nameless" in how else {"program": ID})
        key, payload = "psiu/@call/MNERIM/parafrente", json.dumps(request)
        if "put" in how:
            session.put(key, payload)
        else:
            [reply] = session.get(key, payload=payload)
            assert reply.ok is not None, reply.err and reply.err.payload.to_string()
        print("moved", flush=True)
        sys.stdin.read()
        if "done" in how:
            done = session.liveliness().declare_token(f"psiu/@program/{ID}/done")  # noqa: F841


main()
