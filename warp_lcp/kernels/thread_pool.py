# mypy: ignore-errors
"""A thread pool that executes tables of CPU launches in native code.

One process uses all cores of a machine, with the bits of one thread. A kernel is cut into ranges of
tasks, a fused kernel into slabs of planes, and an idle thread takes the next one, see
`headers/team.h`. The results depend neither on the thread nor on the cuts.
"""

from __future__ import annotations

import atexit
import copy
import ctypes
import functools
import os
import struct
import sys
import threading
import time
import warnings
from array import array
from collections.abc import Callable, Hashable, Iterable, Sequence

import warp as wp

from warp_lcp.deadline import check_time, seconds_left
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.header_text import shared
from warp_lcp.kernels.layout import STRUCT, KernelValue
from warp_lcp.kernels.types import DataType, DeviceArray, Dimensions

VARIABLE = "WARP_LCP_THREADS"
# Environment variables in which MPI launchers give the number of ranks on this machine.
RANKS = ("OMPI_COMM_WORLD_LOCAL_SIZE", "MPI_LOCALNRANKS")
MOST_THREADS = 1024
# Nanoseconds in native code after which the interpreter is asked for signals.
PATIENCE = 50_000_000
# Least cells of a usual kernel in a piece: a microsecond or more; to take a piece costs 0.1.
CELLS = 4096
# Pieces of a thread's share of a kernel: more of them shorten the wait for the last thread.
PIECES = 12
# Spins of an idle thread before it yields its core, 25 ns each: with a core of its own, without.
SPINS = 10000, 2000
COPIED = 1 << 18  # least bytes that a thread copies
ROOM = 4096  # most bytes of the arguments of a kernel that is cut
RUN, SERVE, CANCEL, QUIT = range(4)  # as in team.h, like the constants below
ALONE, TASKS, SLABS, COPY = range(4)
DONE_ALONE, SHARED, RESUMED = 0, 1, 2
TABLE, IDLE_SPINS, CALLS, THREADS, TABLE_WORDS, OPERATION_WORDS, LANE_WORDS = (
    1,
    2,
    56,
    64,
    24,
    13,
    8,
)
COUNT, TOTAL, OPERATIONS, SHARED_TIME, UNFINISHED, AGAIN = range(16, 22)
WITHIN, BETWEEN = 1, 2  # state of an unfinished table: within a run, between two
MOST_ENTRIES = 64  # launch dimensions of a kernel whose entries are cached
# Formats of `struct`.
FORMATS = {
    wp.float32: "f",
    wp.float64: "d",
    float: "f",
    wp.int32: "i",
    int: "i",
    wp.int64: "q",
    wp.bool: "?",
    bool: "?",
}
# Words of the objects that these functions initialize.
MADE = {"pthread_mutex_init": 24, "pthread_cond_init": 40}
LOCKS = (
    "pthread_mutex_lock",
    "pthread_mutex_unlock",
    "pthread_cond_wait",
    "pthread_cond_broadcast",
)
SYSTEM = ("sched_yield", "clock_gettime", "nanosleep", *LOCKS)


@wp.func_native("\n".join(["", shared("team.h"), ""]))
def work_through(
    team_: wp.uint64, table_: wp.uint64, mode: int, me: int, share: int, limit_: wp.int64
):
    """Perform the action `mode` of thread `me`."""


@forward_kernel(module="warp_lcp.team")
def team_kernel(team: wp.uint64, table: wp.uint64, mode: int, me: int, share: int, limit: wp.int64):
    """Perform the action `mode` of thread `me`; one thread."""
    work_through(team, table, mode, me, share, limit)


# A part of a kernel's arguments that is read from memory: offset in them, address, bytes.
Patch = tuple[int, int, int]


class Arguments(ctypes.Structure):
    """Arguments of `team_kernel`."""

    _fields_ = (
        ("team", ctypes.c_uint64),
        ("table", ctypes.c_uint64),
        ("mode", ctypes.c_int32),
        ("me", ctypes.c_int32),
        ("share", ctypes.c_int32),
        ("limit", ctypes.c_int64),
    )


class TableEntry:
    """A CPU kernel: the function for C, and the bounds of a launch.

    Args:
        launch: a recorded launch of it.
    """

    def __init__(self, launch: wp.Launch) -> None:
        self.kernel, self.function = launch.kernel, launch.hooks.forward
        # The module stays loaded. The launch itself is not stored, as it would hold arrays.
        self._keep_alive = launch.module_exec, launch.bounds
        self.call = ctypes.cast(self.function, ctypes.c_void_p).value
        self.bounds = ctypes.addressof(launch.bounds)


class OperationKind:
    """A kernel with arguments, as words for C.

    Args:
        entry: the kernel.
        arguments: their bytes, which begin with the range of tasks if it can be cut.
        kept: objects that must live as long.
        plane_tasks: tasks of a plane.
        planes: number of planes.
        lag: planes that it is behind the first stage of a fused kernel.
        finer: planes of the finer level that one of its planes stands for.
        finer_planes: their number.
        patches: parts of the arguments that are read from memory in each run: offset, address,
            bytes.
    """

    def __init__(
        self,
        entry: TableEntry,
        arguments: bytes,
        keep_alive: object,
        plane_tasks: int = 1,
        planes: int = 1,
        lag: int = 0,
        finer: int = 1,
        finer_planes: int = 0,
        patches: Sequence[Patch] = (),
    ) -> None:
        memory, size = array("B", arguments), len(arguments)
        listed = (
            array("Q", [len(patches), *(word for patch in patches for word in patch)])
            if patches
            else None
        )
        self.keep_alive, self.tasks, self.planes = (
            (entry, memory, keep_alive, listed),
            plane_tasks * planes,
            planes,
        )
        self.patches = tuple(patches)
        if size > ROOM:
            raise ValueError(f"a kernel's arguments take {size} bytes: expected at most {ROOM}")
        where = 0 if listed is None else listed.buffer_info()[0]
        self.words = (
            entry.call,
            entry.bounds,
            memory.buffer_info()[0],
            size,
            plane_tasks,
            planes,
            lag,
            finer,
            finer_planes,
            where,
        )

    def content(self) -> tuple[Hashable, ...]:
        """Return the content of the operation, to compare recordings.

        It is the kernel, its arguments without the patched ones, and the patches; of a copy, its
        words.
        """
        if not isinstance(self.keep_alive, tuple) or not isinstance(self.keep_alive[0], TableEntry):
            return self.words
        memory = bytearray(self.keep_alive[1])
        for offset, _, size in self.patches:
            memory[offset : offset + size] = bytes(size)
        return self.words[0], bytes(memory), self.patches


class Operation:
    """Stages that are executed together: a launch, or a fused kernel.

    Attributes:
        check: raises the error of the operation, once the table is done; None: it cannot fail.
        condition: address of an int32 number; the operation is skipped where it is 0. 0: it is
            never skipped.

    Args:
        kind: ALONE for a launch as it is; TASKS, SLABS for one that is cut; COPY for memory.
        stages: the launches.
        chunks: number of pieces into which it is cut.
        each: tasks, or planes, of a piece.
        everything: tasks, or planes, in all.
        margin: planes that the last stage of a fused kernel is behind the first.
        sized: address of the number of tasks, which may differ from run to run; 0: it is
            `everything`.
    """

    __slots__ = ("_keep_alive", "_stages", "check", "chunks", "condition", "sized", "words")

    def __init__(
        self,
        kind: int,
        stages: list[OperationKind],
        chunks: int = 1,
        each: int = 0,
        total: int = 0,
        margin: int = 0,
        sized: int = 0,
    ) -> None:
        self._stages, self._keep_alive, self.chunks = (
            array("Q", [word for stage in stages for word in stage.words]),
            stages,
            chunks,
        )
        self.check: Callable[[], object] | None = None
        self.condition, self.sized = 0, sized
        self.words = (kind, self._stages.buffer_info()[0], len(stages), each, total, margin, chunks)

    def content(self) -> tuple[Hashable, ...]:
        """Return the operation's content, without values read from memory in each run."""
        return (
            self.words[0],
            self.sized,
            self.condition,
            *(stage.content() for stage in self._keep_alive if isinstance(stage, OperationKind)),
        )

    def name(self) -> str:
        """Return the names of its kernels."""
        return (
            "copy"
            if self.words[0] == COPY
            else ", ".join(
                s.keep_alive[0].kernel.key for s in self._keep_alive if isinstance(s, OperationKind)
            )
        )

    def only_if(self, condition: DeviceArray) -> Operation:
        """Return the same operation, skipped where a number, shape (1,), wp.int32, is 0."""
        made = copy.copy(self)
        made._keep_alive, made.condition = [*self._keep_alive, condition], condition.ptr
        return made


def ranges(stage: OperationKind, cells: int, *, ordered: bool = False, sized: int = 0) -> Operation:
    """Return a stage cut into ranges of its tasks.

    Args:
        stage: the launch.
        cells: cost of a task, in cells of a usual kernel.
        ordered: whether tasks write what others read or write: then it is not cut.
        sized: address of the number of tasks in each run; 0: it is the stage's.
    """
    each, threads = stage.tasks, 1 if ordered else get_threads()
    if sized:
        return Operation(
            TASKS,
            [stage],
            PIECES * threads if threads > 1 else 1,
            -(-CELLS // max(cells, 1)),
            stage.tasks,
            sized=sized,
        )
    if threads > 1:
        count = max(min(PIECES * threads, stage.tasks * cells // CELLS), 1)
        # Every thread gets as many pieces: 5 equal pieces take two threads as long as 6.
        count -= count % threads if count > threads else 0
        each = -(-stage.tasks // count)
    return Operation(TASKS, [stage], -(-stage.tasks // each), each, stage.tasks)


def copied(to: int, source: int, size: int, keep_alive: object) -> Operation:
    """Return the copy of some bytes as an operation.

    Args:
        to: address.
        source: address; 0: zeros.
        size: bytes.
        keep_alive: objects that must live as long.
    """
    stage = object.__new__(OperationKind)
    stage.keep_alive, stage.tasks, stage.planes, stage.patches = keep_alive, 1, 1, ()
    stage.words = source, 0, to, size, 1, 1, 0, 1, 0, 0
    each = max(size if get_threads() == 1 else -(-size // get_threads() // 64) * 64, COPIED)
    return Operation(COPY, [stage], max(-(-size // each), 1), each, size)


class OperationTable:
    """Operations one after another, as a table for C.

    Attributes:
        checks: raise the errors of the operations, after all of the table.

    Args:
        operations: in order.
        again: number on the host, shape (1,), wp.int32, that operations write: the table is run
            until it is 0. None: once.
    """

    def __init__(self, operations: Iterable[Operation], again: DeviceArray | None = None) -> None:
        self._keep_alive = tuple(operations)
        self.checks = {operation.check for operation in self._keep_alive} - {None}
        lanes = [min(get_threads(), operation.chunks) for operation in self._keep_alive]
        # The remaining pieces, and the cuts.
        sizes = [
            LANE_WORDS * n + operation.chunks
            for n, operation in zip(lanes, self._keep_alive, strict=True)
        ]
        at = TABLE_WORDS + OPERATION_WORDS * len(self._keep_alive)
        self.words = array("Q", bytes(8 * (at + sum(sizes))))
        self.address = self.words.buffer_info()[0]
        total, words = 0, []
        for operation, count, size in zip(self._keep_alive, lanes, sizes, strict=True):
            total += operation.chunks
            places = self.address + 8 * at, self.address + 8 * (at + LANE_WORDS * count)
            words += [total, *operation.words, count, *places, operation.sized, operation.condition]
            at += size
        # A slice of the same length, so the array stays at its address.
        self.words[TABLE_WORDS : TABLE_WORDS + len(words)] = array("Q", words)
        self.words[COUNT], self.words[TOTAL], self.words[OPERATIONS] = (
            len(self._keep_alive),
            total,
            self.address + 8 * TABLE_WORDS,
        )
        self.again, self.words[AGAIN] = again, 0 if again is None else again.ptr
        self.cut = total > len(self._keep_alive)
        self.request: Arguments | None = None  # arguments of the last pool of one thread


class ThreadPool:
    """Worker threads that help the caller; the bits are those of one thread.

    Args:
        size: threads, the caller among them.
        entry: of `team_kernel`.
    """

    def __init__(self, size: int, entry: TableEntry) -> None:
        self.size, self._entry = size, entry
        self._function, self._bounds = entry.function, ctypes.c_void_p(entry.bounds)
        self.words = (ctypes.c_uint64 * (THREADS + 8 * size))()
        self.address = ctypes.addressof(self.words)
        for i, function in enumerate(_system()):
            self.words[CALLS + i] = function
        for name, word in MADE.items() if _system() else ():
            ctypes.CDLL(None)[name](ctypes.c_void_p(self.address + 8 * word), None)
        self.words[IDLE_SPINS] = SPINS[size > available_threads()]
        self._lock, self._inside = threading.Lock(), 0
        self._posted, self._retired = None, []
        self.shared_time = 0.0  # seconds of calls that the worker threads took part in
        self._workers = [
            threading.Thread(target=self._serve, args=(me,), daemon=True) for me in range(1, size)
        ]
        for worker in self._workers:
            worker.start()

    def run(self, table: OperationTable) -> None:
        """Execute a table.

        The workers take part if no other thread uses them.
        """
        if self.size == 1 and table.again is None:
            self._run_alone(table)
            return
        with self._lock:
            self._inside += 1
            share = SHARED if table.cut and self.size > 1 and self._inside == 1 else DONE_ALONE
            if share and self._posted is not table.words:
                self._retire(table.words)
        table.words[SHARED_TIME] = 0
        request = Arguments(self.address, table.address, RUN, 0, share, patience(table))
        try:
            self._do(request)
            while unfinished := table.words[UNFINISHED]:  # the interpreter has handled signals
                if table.again is not None:
                    check_time()
                    for check in table.checks:  # a failure may keep the loop from ending
                        check()
                request.share = share + (RESUMED if unfinished == WITHIN else 0)
                request.limit = patience(table)
                self._do(request)
        except BaseException:
            self._do(Arguments(self.address, table.address, CANCEL))
            raise
        finally:
            with self._lock:
                self._inside -= 1
        if share:
            self.shared_time += table.words[SHARED_TIME] * 1e-9
        for check in table.checks:
            check()

    def _run_alone(self, table: OperationTable) -> None:
        """Execute a table on the caller's thread."""
        request = table.request
        if request is None or request.team != self.address:  # of another pool, which was freed
            request = table.request = Arguments(
                self.address, table.address, RUN, 0, DONE_ALONE, PATIENCE
            )
        try:
            self._do(request)
            while table.words[UNFINISHED]:  # the interpreter has handled signals
                self._do(Arguments(self.address, table.address, RUN, 0, RESUMED, PATIENCE))
        except BaseException:
            self._do(Arguments(self.address, table.address, CANCEL))
            raise
        for check in table.checks:
            check()

    def stop(self) -> None:
        """Stop the worker threads.

        Later calls run on the caller's thread.
        """
        self._do(Arguments(self.address, 0, QUIT))
        for worker in self._workers:
            worker.join()
        self.size = 1

    def _retire(self, words: array[int]) -> None:
        """Keep the former words while a late thread may still read them.

        The operations that they describe are done and may be freed.
        """
        seen = {self.words[THREADS + 8 * me] for me in range(1, self.size)}
        self._retired = [old for old in self._retired if old.buffer_info()[0] in seen]
        if self._posted is not None:
            self._retired.append(self._posted)
        self._posted = words

    def _serve(self, me: int) -> None:
        self._do(Arguments(self.address, 0, SERVE, me))

    def _do(self, asked: Arguments) -> None:
        self._function(self._bounds, ctypes.byref(asked))


def patience(table: OperationTable) -> int:
    """Return the time between returns to the interpreter [ns].

    The interpreter then handles signals, and the deadline of a loop.
    """
    return PATIENCE if table.again is None else int(min(PATIENCE, 1e9 * seconds_left()))


def arguments_of(launch: wp.Launch) -> ctypes.Structure:
    """Return the memory of a recorded launch's arguments, in C's layout."""
    params = launch.params[1:]
    return _arguments(*map(type, params))(*params)


@functools.cache
def _arguments(*types: type) -> type[ctypes.Structure]:
    return type(
        "LaunchArguments",
        (ctypes.Structure,),
        {"_fields_": [(f"p{i}", kind) for i, kind in enumerate(types)]},
    )


ALIGNED = {1: "B", 2: "H", 4: "I", 8: "Q"}  # formats of `struct` by their alignment


class Signature:
    """Types of a Warp kernel's arguments, to pack them as C structs.

    Packing takes a tenth of the time that Warp takes to record a launch.

    Attributes:
        entries: by launch dimensions: the kernel as C calls it, and the struct of its arguments.

    Args:
        kernel: with arrays, vectors, structs, and numbers of `FORMATS`; others are left to Warp.
    """

    def __init__(self, kernel: wp.Kernel) -> None:
        self.entries: dict[Dimensions, tuple[TableEntry, type[ctypes.Structure]]] = {}
        self._kinds = [argument.type for argument in kernel.adj.args]
        formats = [] if kernel.is_generic else [_format(kind) for kind in self._kinds]
        self._packing = struct.Struct("".join(formats) + "0Q") if formats and all(formats) else None
        structs = [kind for kind in self._kinds if isinstance(kind, STRUCT)]
        self._structs = {kind: type(kind()) for kind in structs} if self._packing else {}

    def check(self, inputs: Sequence[KernelValue], memory: ctypes.Structure) -> None:
        """Leave all packing to Warp from now on if Warp packs arguments differently."""
        mine = self.pack(inputs)
        if mine is not None and mine[: ctypes.sizeof(memory)] != bytes(memory):
            self._packing = None

    def pack(self, inputs: Sequence[KernelValue]) -> bytes | None:
        """Return arguments packed as in C.

        Returns None where Warp should convert or reject one.
        """
        if self._packing is None:
            return None
        values = []
        for kind, value in zip(self._kinds, inputs, strict=False):
            if kind in FORMATS:
                plain = type(value) in (int, float, bool)
            elif type(value) is wp.array:
                plain = (
                    isinstance(kind, wp.array)
                    and value.dtype is kind.dtype
                    and value.ndim == kind.ndim
                    and value.device.is_cpu
                )
                value = bytes(value.__ctype__())
            elif kind in self._structs:
                plain = type(value) is self._structs[kind]
                value = bytes(value.__ctype__()) if plain else b""
            else:
                plain = type(value) is kind
                value = bytes(value) if plain else b""
            if not plain:
                return None
            values.append(value)
        try:
            return self._packing.pack(*values)
        except (struct.error, OverflowError):
            return None


def _format(kind: DataType | DeviceArray) -> str:
    """Return the `struct` format of an argument type, aligned as in C.

    It is "" for a type that cannot be packed.
    """
    if kind in FORMATS:
        return FORMATS[kind]
    if isinstance(kind, wp.array):
        return f"0Q{ctypes.sizeof(kind.__ctype__())}s"
    if isinstance(kind, STRUCT):
        return f"0{ALIGNED[ctypes.alignment(kind.ctype)]}{ctypes.sizeof(kind.ctype)}s"
    # Elements of a vector or a matrix.
    of = kind._type_ if isinstance(kind, type) and issubclass(kind, ctypes.Array) else None
    of = vars(of).get("_type_", "") if isinstance(of, type) else ""
    return f"0{of}{ctypes.sizeof(kind)}s" if isinstance(of, str) and of else ""


@functools.lru_cache(maxsize=256)
def signature_of(kernel: wp.Kernel) -> Signature:
    """Return the types of a kernel's arguments, and its entries."""
    return Signature(kernel)


def prepared(
    kernel: wp.Kernel, dim: Dimensions, inputs: Sequence[KernelValue]
) -> tuple[TableEntry, bytes, type[ctypes.Structure]]:
    """Return the table entry of a CPU kernel, its arguments, and their struct."""
    signature = signature_of(kernel)
    if (known := signature.entries.get(dim)) is not None and (
        arguments := signature.pack(inputs)
    ) is not None:
        return known[0], arguments, known[1]
    launch = wp.launch(kernel, dim, inputs, device="cpu", record_cmd=True)
    memory = arguments_of(launch)
    signature.check(inputs, memory)
    if len(signature.entries) >= MOST_ENTRIES:
        signature.entries.clear()
    signature.entries[dim] = made = TableEntry(launch), type(memory)
    return made[0], bytes(memory), made[1]


def launched_alone(launch: wp.Launch, keep_alive: object = None) -> Operation:
    """Return a recorded launch as an operation that is not cut.

    `keep_alive` must live as long.
    """
    return Operation(
        ALONE,
        [OperationKind(TableEntry(launch), bytes(arguments_of(launch)), (launch, keep_alive))],
    )


@functools.cache
def _system() -> list[int]:
    """Return the addresses of system functions, and the number of the clock.

    Returns [] where the system does not have them.
    """
    try:
        library = ctypes.CDLL(None)
        addresses = [ctypes.cast(library[name], ctypes.c_void_p).value for name in SYSTEM]
        return [*addresses, time.CLOCK_MONOTONIC]
    except (OSError, TypeError, AttributeError):
        return []


@forward_kernel(module="warp_lcp.team")
def trial_kernel(a: wp.array(dtype=wp.float32), first: int, value: float):
    """Set a[first + i] = value + i."""
    i = wp.tid()
    a[first + i] = value + float(i)


@functools.cache
def _entry() -> TableEntry | None:
    """Return the executor, after a test launch with a known result.

    Returns None, with a notice, if this Warp's launches do not work as expected.
    """
    try:
        entry = TableEntry(
            wp.launch(team_kernel, 1, [0, 0, 0, 0, 0, 0], device="cpu", record_cmd=True)
        )
        a = wp.zeros(8, dtype=wp.float32, device="cpu")
        launch = wp.launch(trial_kernel, 5, [a, 2, 3.0], device="cpu", record_cmd=True)
        ThreadPool(1, entry).run(OperationTable([launched_alone(launch)]))
        if a.numpy().tolist() != [0, 0, 3, 4, 5, 6, 7, 0]:
            raise RuntimeError("a test launch gave a wrong result")
    except Exception as error:
        warnings.warn(
            f"one CPU thread: Warp {wp.__version__} records launches in an unknown format "
            f"({error})",
            stacklevel=2,
        )
        return None
    return entry


def available_threads() -> int:
    """Return the cores that this process may use, shared among ranks of a machine."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    ranks = next((int(os.environ[name]) for name in RANKS if os.environ.get(name, "").isdigit()), 1)
    return min(max(cores // max(ranks, 1), 1), MOST_THREADS)


def _asked_threads() -> int:
    value = os.environ.get(VARIABLE, "")
    if not value:
        return available_threads()
    return _checked(value, VARIABLE)


def _checked(value: int | str, name: str) -> int:
    try:
        count = int(value)
    except (TypeError, ValueError):
        count = 0
    if not 1 <= count <= MOST_THREADS or isinstance(value, float):
        raise ValueError(
            f"{name}: {value!r}: expected a number of threads from 1 to {MOST_THREADS}"
        )
    return count


class PoolState:
    """Number of threads to use, and the pool once it is needed."""

    def __init__(self) -> None:
        self.threads: int | None = None
        self.team: ThreadPool | None = None
        self.lock = threading.Lock()


STATE = PoolState()


def get_threads() -> int:
    """Return the number of threads on the CPU.

    It is the number of `set_threads`, else WARP_LCP_THREADS, else the number of cores.

    Raises:
        ValueError: WARP_LCP_THREADS is no such number.
    """
    if STATE.threads is None:
        STATE.threads = _asked_threads()
    return STATE.threads if _system() else 1


def set_threads(count: int | None) -> None:
    """Set the number of threads on the CPU.

    Results have the same bits for any number.

    Args:
        count: from 1 to 1024; None: the number at the start.

    Raises:
        ValueError: it is no such number.
    """
    asked = _asked_threads() if count is None else _checked(count, "count")
    with STATE.lock:
        if asked != STATE.threads:
            STATE.threads, old, STATE.team = asked, STATE.team, None
            if old is not None:
                old.stop()


def team() -> ThreadPool | None:
    """Return the thread pool, created at its first use.

    Returns None where launches must go through Warp.
    """
    if STATE.team is None:
        entry = _entry()
        if entry is None:
            return None
        with STATE.lock:
            if STATE.team is None:
                STATE.team = ThreadPool(get_threads(), entry)
    return STATE.team


def shared_seconds() -> float:
    """Return the time that callers have worked together with the pool's threads."""
    return 0.0 if STATE.team is None else STATE.team.shared_time


def _forget() -> None:
    """Drop the pool in a forked child: its threads belong to the parent."""
    STATE.team, STATE.lock = None, threading.Lock()


def _leave() -> None:
    """Stop the worker threads before the interpreter ends."""
    if STATE.team is not None:
        STATE.team.stop()


atexit.register(_leave)
if sys.platform != "win32":
    os.register_at_fork(after_in_child=_forget)
