"""Call a robot, then print what all robots say: python plain_zenoh.py MNERIM parafrente 100"""

import json
import sys
from contextlib import suppress

import zenoh

BROKER = "tcp/127.0.0.1:7447"


def main(robot: str, command: str, *numbers: str) -> None:
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [BROKER]}}))
    with zenoh.open(config) as session:
        # A ring drops the oldest when it is full; it never holds up the answer to a call.
        heard = session.declare_subscriber("psiu/**", zenoh.handlers.RingChannel(1000))

        request = json.dumps({"parameters": [int(number) for number in numbers]})
        for reply in session.get(f"psiu/@call/{robot}/{command}", payload=request, timeout=30):
            if reply.ok:
                print("answer:", reply.ok.payload.to_string())
            else:
                print("no answer:", reply.err.payload.to_string())

        with suppress(KeyboardInterrupt):  # Ctrl-C ends it
            for sample in heard:
                print(sample.key_expr, sample.payload.to_string())


if __name__ == "__main__":
    main(*sys.argv[1:])
