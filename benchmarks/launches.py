"""Listen to the kernels that a solve launches, run each again by itself, and find what memory it must move.

Warp's `wp.launch` is wrapped by `install`, which also takes the place of the plain one where functions have that as a default argument.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FunctionType
from typing import Any

import numpy as np
import warp as wp

SEED = 20150611
COEFFICIENTS = ("wx", "wy", "wz", "face_x", "face_y", "face_z", "shift", "spans")  # absent where they are numbers, or rows whole


@dataclass
class Launch:
    """A kernel launch that can be run again."""

    kernel: Any  # the kernel
    dim: Any  # threads
    arguments: list[Any]  # inputs and outputs
    device: Any  # where it runs
    block_dim: int  # threads of a block
    count: int = 1  # how often a launch like it was heard
    _command: Any = None

    @property
    def name(self) -> str:
        """Area and name of the kernel, types, flags that are set, fields that are absent: `cycle.sweep uniform_uint8_float32 from_zero`."""
        _, _, rest = self.kernel.module.name.partition(".")
        area, _, types = rest.partition(".")
        types = types.rpartition(".")[2]
        called = self.kernel.func.__name__.removesuffix("_kernel")
        absent = [f"-{label}" for label, a in self._given() if _is_nothing(a) and label not in COEFFICIENTS]
        flags = [label for label, value in self._given() if value is True]
        return " ".join(part for part in (f"{area}.{called}", types, *flags, *absent) if part)

    @property
    def arrays(self) -> dict[str, wp.array[Any]]:
        """Arrays of numbers among the arguments; of those that are the same memory, the first."""
        found: dict[int, tuple[str, wp.array[Any]]] = {}
        for label, value in self._given():
            if isinstance(value, wp.array) and value.size > 0 and value.dtype in (wp.float32, wp.float64, wp.uint8, wp.int8):
                found.setdefault(value.ptr, (label, value))
        return dict(found.values())

    def indexed(self, smallest: int) -> bool:
        """Return whether it has a field of integers of at least `smallest` elements."""
        return any(isinstance(a, wp.array) and a.dtype is wp.int32 and a.size >= smallest for _, a in self._given())

    def run(self) -> None:
        """Launch it again."""
        if self._command is None:
            inputs = {"inputs": self.arguments, "device": self.device, "block_dim": self.block_dim}
            self._command = _plain_launch(self.kernel, self.dim, record_cmd=True, **inputs)
        self._command.launch()

    def _given(self) -> list[tuple[str, Any]]:
        pairs = zip((a.label for a in self.kernel.adj.args), self.arguments, strict=True)
        found: dict[str, Any] = {}
        for label, value in (member for pair in pairs for member in _members(*pair)):
            known = isinstance(value, wp.array) and isinstance(found.get(label), wp.array) and found[label].ptr != value.ptr
            found.setdefault(f"{label} of another pass" if known else label, value)
        return list(found.items())


def _members(label: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield an argument, or what is in a struct."""
    if not hasattr(value, "_cls"):
        yield label, value
        return
    for name in value._cls.vars:
        yield from _members(name, getattr(value, name))


def _is_nothing(value: Any) -> bool:
    return value is None or (isinstance(value, wp.array) and value.size == 0)


@dataclass(frozen=True)
class Traffic:
    """Which fields a launch reads and which it writes; counts each field once a direction, whatever a stencil reads twice."""

    reads: dict[str, int] = field(default_factory=dict)  # bytes by argument
    writes: dict[str, int] = field(default_factory=dict)

    @property
    def bytes(self) -> int:
        """Bytes that must be moved."""
        return sum(self.reads.values()) + sum(self.writes.values())


_plain_launch: Callable[..., Any] = wp.launch
_heard: list[Launch] | None = None


def install() -> None:
    """Wrap `wp.launch`; does nothing the second time."""
    if getattr(wp.launch, "listens", False):
        return

    def launch(kernel: Any, dim: Any, inputs: Any = (), outputs: Any = (), **options: Any) -> Any:
        if _heard is not None:
            device = wp.get_device(options.get("device"))
            _heard.append(Launch(kernel, dim, [*inputs, *outputs], device, options.get("block_dim") or 256))
        return _plain_launch(kernel, dim, inputs, outputs, **options)

    launch.listens = True  # type: ignore[attr-defined]
    wp.launch = launch
    for function in [f for f in gc.get_objects() if isinstance(f, FunctionType)]:
        if any(value is _plain_launch for value in function.__defaults__ or ()):
            function.__defaults__ = tuple(launch if value is _plain_launch else value for value in function.__defaults__ or ())
        if any(value is _plain_launch for value in (function.__kwdefaults__ or {}).values()):
            named = (function.__kwdefaults__ or {}).items()
            function.__kwdefaults__ = {name: launch if value is _plain_launch else value for name, value in named}


@contextmanager
def listen() -> Iterator[list[Launch]]:
    """Collect the launches made meanwhile, recorded ones included."""
    global _heard  # noqa: PLW0603 - one wrapped function, one listener
    heard: list[Launch] = []
    _heard = heard
    try:
        yield heard
    finally:
        _heard = None


def distinct(heard: list[Launch], smallest: int) -> list[Launch]:
    """Return one launch of each kind that touches a field of at least `smallest` elements, with counts.

    Kernels with a field of integers are left out: they follow these as indices, which other kernels may have overwritten meanwhile.
    """
    kinds: dict[str, Launch] = {}
    for launch in heard:
        if max((a.size for a in launch.arrays.values()), default=0) < smallest or launch.indexed(smallest):
            continue
        kept = kinds.setdefault(launch.name, launch)
        kept.count += kept is not launch
    return list(kinds.values())


def traffic(launch: Launch, sizes: dict[int, int]) -> Traffic:
    """Find what a launch reads and writes by changing each of its fields and looking at what follows.

    A field is written if its values after the launch are not those put in before, and read if another result, or its own, depends on
    them. All begin with random numbers, so that a result depends on what it may depend on; fields are as they were afterwards.

    Args:
        launch: the launch; deterministic.
        sizes: elements of stored fields and the cells that they stand for; smaller arrays are not counted.
    """
    arrays, random = launch.arrays, np.random.default_rng(SEED)
    before = {label: a.numpy().copy() for label, a in arrays.items()}
    floats = [label for label, values in before.items() if values.dtype.kind == "f"]
    saved = before | {label: _other_values(random, before[label]) for label in floats}
    saved |= {label: 1.5 + 0.5 * np.tanh(saved[label]) for label in floats if arrays[label].size not in sizes}  # scalars: lengths, norms
    _restore(arrays, saved)
    launch.run()
    expected = {label: a.numpy().copy() for label, a in arrays.items()}
    found = Traffic()
    for label, a in arrays.items():
        if a.size not in sizes:
            continue
        _restore(arrays, saved)
        other = _other_values(random, saved[label])
        a.assign(other)
        launch.run()
        after = a.numpy()
        changed = after != other
        depends = bool((changed & (after != expected[label]) & ~(np.isnan(after) & np.isnan(expected[label]))).any())
        depends = depends or any(
            not np.array_equal(b.numpy(), expected[name], equal_nan=b.dtype not in (wp.uint8, wp.int8))
            for name, b in arrays.items()
            if name != label
        )
        cells = sizes[a.size] * wp.types.type_size_in_bytes(a.dtype)
        if depends:
            found.reads[label] = cells
        if changed.any():
            found.writes[label] = cells
    _restore(arrays, before)
    return found


def _restore(arrays: dict[str, wp.array[Any]], saved: dict[str, np.ndarray]) -> None:
    for label, a in arrays.items():
        a.assign(saved[label])


def _other_values(random: np.random.Generator, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind == "f":
        return random.standard_normal(values.shape, dtype=np.float32).astype(values.dtype)
    return random.integers(0, 3 if values.dtype == np.int8 else 7, values.shape).astype(values.dtype)


def stored_sizes(counts: tuple[int, int, int], levels: int = 2) -> dict[int, int]:
    """Return elements of a padded field, and the cells in it, of a grid and of the next coarser ones."""
    found = {}
    for _ in range(levels):
        found[math.prod(n + 2 for n in counts)] = math.prod(counts)
        counts = (-(-counts[0] // 2), -(-counts[1] // 2), -(-counts[2] // 2))
    return found
