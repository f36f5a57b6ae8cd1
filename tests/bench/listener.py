"""A program that listens to all that robots say: python listener.py ENDPOINT; a line in, the count so far out."""

import itertools
import json
import sys

import zenoh


def main() -> None:
    configuration = {"mode": "client", "connect": {"endpoints": [sys.argv[1]]}}
    counter = itertools.count()

    def count(sample: zenoh.Sample) -> None:
        if str(sample.key_expr).count("/") > 1:  # no card
            next(counter)

    with zenoh.open(zenoh.Config.from_json5(json.dumps(configuration))) as session:
        session.declare_subscriber("psiu/**", count)
        for asked, _ in enumerate(sys.stdin):
            print(next(counter) - asked, flush=True)


if __name__ == "__main__":
    main()
