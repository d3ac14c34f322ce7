"""Instructions, loads, stores and L1 wavefronts that a warp of a kernel issues.

The lanes of the warp are executed one after another (`benchmarks/machine_thread.py`). An
instruction of the warp is issued as often as by the lane that executes it most often, because
branches join again.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from benchmarks.machine_code import Instruction
from benchmarks.machine_memory import EmulatedMemory
from benchmarks.machine_thread import Lane, decoded

FLOAT64 = frozenset(("DADD", "DMUL", "DFMA", "DSETP", "DMNMX"))
ATOMIC = frozenset(("RED", "REDG", "ATOM", "ATOMG"))
LOCAL = frozenset(("LDL", "STL"))
# Kinds of instructions, by the names of these; the rest are integers: indices and their tests.
KINDS = {
    "float": "FADD FMUL FFMA FMNMX MUFU FCHK " + " ".join(sorted(FLOAT64 - {"DSETP"})),
    "conversions": "I2F I2FP F2F F2FP F2I FRND",
    "selections": "SEL FSEL FSET FSETP DSETP USEL",
    "loads": "LDG LD LDL LDS LDC ULDC",
    "stores": "STG ST STL STS",
    "bytes": "PRMT LOP3 ULOP3 PLOP3 UPLOP3",
    "moves": "MOV UMOV R2UR P2R R2P CS2R S2R S2UR",
    "jumps": "BRA EXIT CALL RET BSSY BSYNC WARPSYNC NOP BREAK YIELD BMOV",
}
KIND_OF = {name: kind for kind, names in KINDS.items() for name in names.split()}


@dataclass
class IssuedInstructions:
    """Counts of a warp.

    Attributes:
        instructions: issued instructions.
        float64: of these, in float64.
        loads: from global memory.
        stores: to global memory.
        wavefronts: passes through the L1 cache, of at most 128 bytes and one line each.
        atomics: of the instructions, atomic ones on global memory.
        local: of the instructions, those that load or store registers kept in memory.
        waits: how often a thread waits for memory, one wait after another.
        read: addresses in global memory that are loaded.
        written: those that are stored.
        kinds: issued instructions by `KINDS`; `index` counts the others.
    """

    instructions: int = 0
    float64: int = 0
    loads: int = 0
    stores: int = 0
    wavefronts: int = 0
    atomics: int = 0
    local: int = 0
    waits: int = 0
    read: frozenset[int] = frozenset()
    written: frozenset[int] = frozenset()
    kinds: Counter[str] = field(default_factory=Counter)


def issued(
    code: dict[int, Instruction],
    constants: bytes,
    memory: EmulatedMemory,
    threads: Sequence[tuple[int, int]],
) -> IssuedInstructions:
    """Count the instructions of a warp.

    Its threads have these pairs (index in the block, index of the block).

    Raises:
        NotImplementedError: the kernel has an instruction that is not known here.
    """
    most: Counter[int] = Counter()
    groups: dict[tuple[int, int, bool], list[tuple[int, int]]] = defaultdict(list)
    waits, program = 0, decoded(code)
    for thread, block in threads:
        lane = Lane(code, constants, memory, thread, block, program=program)
        lane.run()
        waits = max(waits, lane.waits)
        for at, count in lane.count.items():
            most[at] = max(most[at], count)
        for at, turn, address, size, is_load in lane.accesses:
            groups[at, turn, is_load].append((address, size))
    of = lambda names: sum(n for at, n in most.items() if code[at].name in names)  # noqa: E731
    counts = IssuedInstructions(sum(most.values()), waits=waits)
    counts.float64, counts.atomics, counts.local = of(FLOAT64), of(ATOMIC), of(LOCAL)
    for at, n in most.items():
        moves = code[at].name == "IMAD" and "MOV" in code[at].modifiers
        counts.kinds["moves" if moves else KIND_OF.get(code[at].name, "index")] += n
    reached: dict[bool, set[int]] = {True: set(), False: set()}
    for (_, _, is_load), accesses in groups.items():
        reached[is_load] |= {address for address, _ in accesses}
        lines = {
            byte // 128 for address, size in accesses for byte in (address, address + size - 1)
        }
        counts.loads += is_load
        counts.stores += not is_load
        counts.wavefronts += max(len(lines), -(-sum(size for _, size in accesses) // 128))
    counts.read, counts.written = frozenset(reached[True]), frozenset(reached[False])
    return counts


def mean_of(issues: Sequence[IssuedInstructions]) -> IssuedInstructions:
    """Return the mean of what some warps issue, rounded, with all addresses that they reach."""

    def mean(of: Callable[[IssuedInstructions], int]) -> int:
        return round(sum(of(one) for one in issues) / len(issues))

    return IssuedInstructions(
        mean(lambda one: one.instructions),
        mean(lambda one: one.float64),
        mean(lambda one: one.loads),
        mean(lambda one: one.stores),
        mean(lambda one: one.wavefronts),
        mean(lambda one: one.atomics),
        mean(lambda one: one.local),
        mean(lambda one: one.waits),
        frozenset[int]().union(*(one.read for one in issues)),
        frozenset[int]().union(*(one.written for one in issues)),
    )
