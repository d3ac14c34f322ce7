"""The peer's side of the exchange: a line of JSON asks, a line of JSON answers; arrays travel in .npz files."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

Request = dict[str, Any]
Reply = dict[str, Any]


def serve(version: str, methods: Mapping[str, Callable[[Request], Reply]], failures: tuple[type[Exception], ...] = ()) -> None:
    """Answer requests until the input ends; the first line that is sent tells the peer's version.

    Args:
        version: of the peer.
        methods: what can be asked for, by the request's `method`.
        failures: what methods raise where they fail; the answer is then {"error": text}. Anything else ends the program.
    """
    replies = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what the peer prints must not get between the answers

    def send(reply: Reply) -> None:
        replies.write(json.dumps(reply) + "\n")
        replies.flush()

    send({"version": version, "methods": sorted(methods)})
    for line in sys.stdin:
        request = json.loads(line)
        try:
            send(methods[request["method"]](request))
        except failures as error:
            send({"error": (str(error).splitlines() or [type(error).__name__])[-1]})
