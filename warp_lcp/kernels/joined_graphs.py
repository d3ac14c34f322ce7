"""CUDA graphs of consecutive stretches of a step, joined into one graph.

Within `joined` a recorded stretch is not launched at once. It is queued, with the numbers that it
reads in this run, until the host or Warp needs the device: for a readback, a launch or copy that is
not recorded, the end of the step. All queued stretches are then launched as one graph, which is
captured when their sequence comes for the second time. A stretch is launched at once if the device
is idle, after a readback: then the host prepares the next ones while the device works.

Nothing is reordered: the functions of Warp by which anything else reaches the device (`SETTLING`)
first launch the queue. So a profile, which synchronizes at the end of each stage, still has the
time of each stage alone.
"""

from __future__ import annotations

import functools
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import warp as wp

from warp_lcp.kernels.launch_graph import LaunchGraph

if TYPE_CHECKING:
    from warp_lcp.kernels.device_graph import DeviceGraph

ParametersT = ParamSpec("ParametersT")
ReturnT = TypeVar("ReturnT")
MOST_SEQUENCES = 64  # sequences that are remembered
# The device is idle after these functions.
WAITING_FOR = ("synchronize", "synchronize_device", "synchronize_stream", "numpy")
# Functions of Warp that give work to a device or wait for it, and the modules where callers look
# them up.
SETTLING: tuple[tuple[ModuleType | type, tuple[str, ...]], ...] = (
    (
        wp,
        (
            "launch",
            "launch_tiled",
            "copy",
            "clone",
            "capture_launch",
            "capture_while",
            "capture_if",
            "record_event",
        ),
    ),
    (wp, ("synchronize", "synchronize_device", "synchronize_stream")),
    (wp.Launch, ("launch",)),
    (wp.array, ("assign", "zero_", "fill_", "to", "list", "numpy")),
    (
        wp.utils,
        (
            "radix_sort_pairs",
            "segmented_sort_pairs",
            "array_scan",
            "array_sum",
            "array_inner",
            "runlength_encode",
        ),
    ),
)


class _StretchQueue(threading.local):
    """Queue of this thread's stretches, in the order of launching."""

    depth = 0  # nesting of `joined`
    idle = True  # whether the device has finished all launches of this thread

    def __init__(self) -> None:
        self.programs: list[DeviceGraph] = []


WAITING = _StretchQueue()
# Weak references to the stretches, and their graph once there is one.
_sequences: dict[tuple[int, ...], tuple[tuple[weakref.ref[DeviceGraph], ...], wp.Graph | None]] = {}


@contextmanager
def joined(device: wp.Device) -> Iterator[None]:
    """Join the graphs of consecutive recorded stretches.

    On the CPU, and without graphs of steps, it does nothing.
    """
    if not (device.is_cuda and LaunchGraph.on_device):
        yield
        return
    _settle_before_warp()
    WAITING.depth += 1
    try:
        yield
    finally:
        WAITING.depth -= 1
        settle()


def queue_stretch(program: DeviceGraph) -> bool:
    """Queue a stretch whose changed arguments are in its buffer.

    Returns False if it is to be launched now.
    """
    if not (WAITING.depth and program.has_run) or WAITING.idle:
        WAITING.idle = False
        return False
    WAITING.programs.append(program)
    return True


def settle(program: DeviceGraph | None = None) -> None:
    """Launch the queue; with a `program`, only if that is queued."""
    programs = WAITING.programs
    if not programs or (program is not None and all(other is not program for other in programs)):
        return
    WAITING.programs = []
    graph = None if len(programs) == 1 else _graph_of(programs)
    if graph is None:
        for stretch in programs:
            stretch.launch_now()
        return
    wp.capture_launch(graph)
    for stretch in programs:
        stretch.note_launch()


def _graph_of(programs: list[DeviceGraph]) -> wp.Graph | None:
    """Return the graph of a sequence of stretches.

    Returns None when the sequence comes for the first time.
    """
    key = tuple(map(id, programs))
    references, graph = _sequences.get(key, ((), None))
    if len(references) != len(programs) or any(
        of() is not program for of, program in zip(references, programs, strict=True)
    ):
        if len(_sequences) >= MOST_SEQUENCES:
            _sequences.clear()
        forget = functools.partial(_forget, key)
        _sequences[key] = tuple(weakref.ref(program, forget) for program in programs), None
        return None
    if graph is None:
        graph = programs[0].captured(
            [command for program in programs for command in program.commands]
        )
        _sequences[key] = references, graph
    return graph


def _forget(key: tuple[int, ...], reference: weakref.ref[DeviceGraph]) -> None:
    """Forget a sequence after one of its stretches was deleted."""
    _sequences.pop(key, None)


@functools.cache
def _settle_before_warp() -> None:
    """Patch functions of Warp to launch the queue first."""
    for owner, names in SETTLING:
        for name in names:
            if (plain := vars(owner).get(name)) is not None:
                setattr(owner, name, _settling(plain, idle=name in WAITING_FOR))


def _settling(
    plain: Callable[ParametersT, ReturnT], *, idle: bool
) -> Callable[ParametersT, ReturnT]:
    """Return a function of Warp that first launches the queued stretches.

    `idle`: the device has finished all work after it.
    """

    @functools.wraps(plain)
    def called(*args: ParametersT.args, **options: ParametersT.kwargs) -> ReturnT:
        if WAITING.programs and not options.get("record_cmd"):
            settle()
        found = plain(*args, **options)
        WAITING.idle = idle or WAITING.idle
        return found

    return called
