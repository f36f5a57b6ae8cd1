"""A program on a broker's bus, in a process of its own: python -m tests.system.caller tcp/127.0.0.1:7447

It reads requests from stdin, one JSON object a line, and writes an answer to each to stdout as it comes:

    {"id": 1, "call": ["BETA2", "marca", "call17"], "timeout_s": 0.5}  ->  {"id": 1, "answer": ["call17"]}
    {"id": 2, "ask": ["base", "mesh"]}                              ->  {"id": 2, "answer": {...}}

or ``{"id": 1, "error": "..."}``. It ends with its stdin.
"""

import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

from psiu_broker.bus.client import Client
from psiu_broker.errors import BusError, PsiuError
from psiu_broker.messages import CallRequest

AT_ONCE = 64
ASK_TIMEOUT_S = 1.0


class Caller:
    """A client that connects once its broker is there; when the broker comes back, Zenoh connects it again."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._client: Client | None = None
        self._tell = threading.Lock()
        self._closing = False
        self._connecting = threading.Thread(target=self._connect)
        self._connecting.start()

    def serve(self, request: dict[str, Any]) -> None:
        """Write one answer. Any thread."""
        answer: dict[str, Any] = {"id": request["id"]}
        try:
            answer["answer"] = self._do(request)
        except PsiuError as error:
            answer["error"] = f"{getattr(error, 'code', 'bus')}: {error}"
        with self._tell:
            print(json.dumps(answer), flush=True)

    def close(self) -> None:
        self._closing = True
        self._connecting.join()
        if self._client is not None:
            self._client.close()

    def _do(self, request: dict[str, Any]) -> Any:
        client = self._client
        if client is None:
            raise BusError("not connected yet")
        if "call" in request:
            robot, command, *parameters = request["call"]
            wanted = CallRequest(parameters=parameters, timeout_s=request["timeout_s"])
            return client.call(robot, command, wanted).values
        broker, *what = request["ask"]
        found = client.ask(*what, broker=broker, timeout_s=ASK_TIMEOUT_S)
        if broker not in found:
            raise BusError(f"{broker} does not answer")
        return found[broker]

    def _connect(self) -> None:
        while self._client is None and not self._closing:
            with suppress(BusError):
                self._client = Client([self._endpoint])


def main() -> None:
    caller = Caller(sys.argv[1])
    with ThreadPoolExecutor(AT_ONCE) as threads:
        try:
            for line in sys.stdin:
                threads.submit(caller.serve, json.loads(line))
        finally:
            threads.shutdown(wait=True, cancel_futures=True)
            caller.close()


if __name__ == "__main__":
    main()
