"""Seconds spent in functions of a module while something else runs."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import warp as wp


@contextmanager
def timed(device: str, functions: dict[str, tuple[ModuleType | type, str]]) -> Iterator[dict[str, list[float]]]:
    """Time every call of functions that callers look up in a module or a class.

    Args:
        device: synchronized around each call.
        functions: where each is looked up, by label.

    Yields:
        Seconds of the calls so far, by label.
    """
    seconds: dict[str, list[float]] = defaultdict(list)
    plain = {label: getattr(module, name) for label, (module, name) in functions.items()}

    def watch(label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            wp.synchronize_device(device)
            begun = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                wp.synchronize_device(device)
                seconds[label].append(time.perf_counter() - begun)

        return call

    for label, (module, name) in functions.items():
        setattr(module, name, watch(label, plain[label]))
    try:
        yield seconds
    finally:
        for label, (module, name) in functions.items():
            setattr(module, name, plain[label])
