"""Emulator of machine code: instructions against plain formulas."""

import ctypes
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.machine_code import Instruction, parsed
from benchmarks.machine_counts import issued
from benchmarks.machine_memory import (
    LOCAL_WINDOW,
    SHARED_WINDOW,
    STACK,
    EmulatedMemory,
    ProcessMemory,
    constants_of,
    packed,
)
from benchmarks.machine_thread import Lane

AT = 0x7000_0000_0000  # address of the memory
COUNT = 8  # its elements


def code_of(*lines: str) -> dict[int, Instruction]:
    return {16 * n: parsed(line) for n, line in enumerate((*lines, "EXIT"))}


def lane_of(memory: EmulatedMemory, *lines: str, thread: int = 0) -> Lane:
    """Execute a thread with the address of the memory in R2 and R3."""
    lane = Lane(code_of(*lines), constants_of(b"", 32, 1), memory, thread, 0)
    lane.registers |= {"R2": AT & 0xFFFFFFFF, "R3": AT >> 32}
    lane.run()
    return lane


def memory_of(values: np.ndarray) -> EmulatedMemory:
    return EmulatedMemory([(AT, values)])


def bits_of(value: float) -> str:
    return hex(struct.unpack("<I", struct.pack("<f", value))[0])


@pytest.mark.every_case
@pytest.mark.parametrize(
    ("kind", "holds"),
    [
        ("GT", lambda a, b: a > b),
        ("LT", lambda a, b: a < b),
        ("NEU", lambda a, b: a != b),
        ("GEU", lambda a, b: not a < b),
    ],
)
@pytest.mark.parametrize("a", [1.5, 0.0, -2.0, float("nan")])
def test_float_set(kind: str, holds: Callable[[float, float], bool], a: float) -> None:
    lane = lane_of(
        memory_of(np.zeros(COUNT, np.int32)),
        f"MOV R4, {bits_of(a)}",
        f"FSET.BF.{kind}.AND R5, R4, RZ, PT",
        f"FSET.{kind}.AND R6, R4, RZ, PT",
    )
    assert lane.registers["R5"] == (0x3F800000 if holds(a, 0.0) else 0)
    assert lane.registers["R6"] == (0xFFFFFFFF if holds(a, 0.0) else 0)


@pytest.mark.parametrize(
    ("name", "old", "operand", "new"),
    [
        ("ADD", 7, 5, 12),
        ("ADD", 0xFFFFFFFF, 1, 0),
        ("MIN", 7, 0xFFFFFFFF, 7),
        ("MIN.S32", 7, 0xFFFFFFFF, 0xFFFFFFFF),
        ("MAX.S32", 7, 0xFFFFFFFF, 7),
        ("AND", 12, 10, 8),
        ("OR", 12, 10, 14),
        ("XOR", 12, 10, 6),
        ("EXCH", 12, 10, 10),
    ],
)
def test_atomics_of_integers(name: str, old: int, operand: int, new: int) -> None:
    memory = memory_of(np.full(COUNT, old, np.uint32))
    lane = lane_of(
        memory,
        f"MOV R4, {operand:#x}",
        f"ATOMG.E.{name}.STRONG.GPU PT, R5, desc[UR4][R2.64+0x4], R4",
    )
    assert lane.registers["R5"] == old
    found = [int.from_bytes(memory.read(AT + 4 * n, 4), "little") for n in range(3)]
    assert found == [old, new, old]


def test_compare_and_swap() -> None:
    memory = memory_of(np.arange(COUNT, dtype=np.uint32))
    lines = ["MOV R4, 0x1", "MOV R5, 0x9"]
    lines += [
        f"ATOMG.E.CAS.STRONG.GPU PT, R{6 + n}, desc[UR4][R2.64+{4 * n:#x}], R4, R5"
        for n in range(3)
    ]
    lane = lane_of(memory, *lines)
    assert [lane.registers[f"R{6 + n}"] for n in range(3)] == [0, 1, 2]
    found = [int.from_bytes(memory.read(AT + 4 * n, 4), "little") for n in range(3)]
    assert found == [0, 9, 2]


def test_wide_address_without_a_mark() -> None:
    """Generic compare and swap: 64-bit address printed as one register; the predicate is set."""
    memory = memory_of(np.array([5, 0], np.int64))
    lane = lane_of(
        memory,
        "MOV R4, 0x5",
        "MOV R6, 0x9",
        "ATOM.E.CAS.64.STRONG.GPU P1, R10, [R2], R4, R6",
        "LD.E.64 R12, [R2]",
        "ST.E.64 [R2+0x8], R12",
    )
    assert lane.predicates["P1"]
    assert (lane.registers["R10"], lane.registers["R12"]) == (5, 9)
    assert int.from_bytes(memory.read(AT + 8, 8), "little") == 9


def test_reductions_of_reals() -> None:
    single, double = np.full(COUNT, 0.1, np.float32), np.full(COUNT, 0.1)
    memory = memory_of(single)
    lane_of(
        memory, f"MOV R4, {bits_of(0.7)}", "REDG.E.ADD.F32.FTZ.RN.STRONG.GPU desc[UR4][R2.64], R4"
    )
    assert memory.read(AT, 4) == (np.float32(0.1) + np.float32(0.7)).tobytes()
    memory = memory_of(double)
    low, high = struct.unpack("<II", struct.pack("<d", 0.7))
    lane_of(
        memory,
        f"MOV R4, {low:#x}",
        f"MOV R5, {high:#x}",
        "REDG.E.ADD.F64.RN.STRONG.GPU desc[UR4][R2.64], R4",
    )
    assert memory.read(AT, 8) == np.float64(0.1 + 0.7).tobytes()


def test_atomics_of_shared_memory() -> None:
    memory = memory_of(np.zeros(COUNT, np.uint32))
    lines = ["MOV R4, 0x3", "ATOMS.ADD R5, [R6+0x10], R4", "LDS R7, [R6+0x10]"]
    first, second = lane_of(memory, *lines), lane_of(memory, *lines)
    assert (first.registers["R5"], first.registers["R7"]) == (0, 3)
    assert (second.registers["R5"], second.registers["R7"]) == (3, 6)


def test_counting_threads() -> None:
    memory = memory_of(np.zeros(COUNT, np.uint32))
    for _ in range(3):
        lane = lane_of(memory, "ATOMS.POPC.INC.32 RZ, [R6]", "LDS R7, [R6]")
    assert lane.registers["R7"] == 3


def test_atomics_of_a_warp_take_turns() -> None:
    memory = memory_of(np.zeros(COUNT, np.uint32))
    code = code_of(
        f"MOV R2, {AT & 0xFFFFFFFF:#x}",
        f"MOV R3, {AT >> 32:#x}",
        "MOV R4, 0x1",
        "REDG.E.ADD.STRONG.GPU desc[UR4][R2.64], R4",
    )
    found = issued(code, constants_of(b"", 32, 1), memory, [(t, 0) for t in range(32)])
    assert int.from_bytes(memory.read(AT, 4), "little") == 32
    assert (found.instructions, found.atomics, found.stores) == (5, 1, 1)


@pytest.mark.parametrize("value", [4.0, 0.3, 1e30, 0.0])
def test_starts_of_divisions_and_roots(value: float) -> None:
    high = struct.unpack("<II", struct.pack("<d", value))[1]
    lane = lane_of(
        memory_of(np.zeros(COUNT, np.int32)),
        f"MOV R5, {high:#x}",
        "MUFU.RCP64H R7, R5",
        "MUFU.RSQ64H R9, R5",
    )
    with np.errstate(divide="ignore"):
        both = {"R7": 1 / np.float64(value), "R9": 1 / np.sqrt(np.float64(value))}
    for register, expected in both.items():
        found = struct.unpack("<d", struct.pack("<II", 0, lane.registers[register]))[0]
        assert found == pytest.approx(expected, rel=1e-5)


@pytest.mark.every_case
@pytest.mark.parametrize("a", [1.0, 2.0, float("nan")])
@pytest.mark.parametrize("b", [1.5, float("nan")])
@pytest.mark.parametrize(("kind", "of"), [("MAX", np.fmax), ("MIN", np.fmin)])
def test_larger_and_smaller_of_two(kind: str, of: np.ufunc, a: float, b: float) -> None:
    lines = []
    for register, value in ((4, a), (6, b)):
        low, high = struct.unpack("<II", struct.pack("<d", value))
        lines += [f"MOV R{register}, {low:#x}", f"MOV R{register + 1}, {high:#x}"]
    lines += [f"DSETP.{kind}.AND P0, P1, R4, R6, PT"]
    lines += ["FSEL R8, R4, R6, P0", "FSEL R9, R5, R7, P0"]
    lane = lane_of(memory_of(np.zeros(COUNT, np.int32)), *lines)
    found = struct.unpack("<d", struct.pack("<II", lane.registers["R8"], lane.registers["R9"]))[0]
    assert found == of(a, b) or (np.isnan(found) and np.isnan(of(a, b)))


@pytest.mark.parametrize(
    ("mask", "value"), [(0x1, 0x0), (0x2, 0x2), (0x40, 0x40), (0x7F, 0b1000010)]
)
def test_uniform_predicates_to_a_register(mask: int, value: int) -> None:
    lane = lane_of(
        memory_of(np.zeros(COUNT, np.int32)),
        "UISETP.EQ.AND UP1, UP2, URZ, 0x0, UPT",  # UP1 is true, UP2 false
        "UISETP.NE.AND UP3, UP6, URZ, 0x0, UPT",  # UP3 is false, UP6 true
        "ISETP.EQ.AND P0, P1, RZ, 0x0, PT",  # not of the uniform ones
        f"UP2UR UR44, UPR, URZ, {mask:#x}",
        f"P2R R5, PR, RZ, {mask:#x}",
    )
    assert lane.registers["UR44"] == value
    assert lane.registers["R5"] == mask & 0x1


def test_uniform_predicates_from_a_register() -> None:
    lane = lane_of(memory_of(np.zeros(COUNT, np.int32)), "UMOV UR4, 0x5", "UR2UP UPR, UR4, 0x7")
    assert [lane.predicates[f"UP{n}"] for n in range(3)] == [True, False, True]
    assert not any(lane.predicates[f"P{n}"] for n in range(3))


@pytest.mark.parametrize("kind", ["EQ", "NE"])
def test_vote_to_a_predicate(kind: str) -> None:
    lane = lane_of(
        memory_of(np.zeros(COUNT, np.int32)),
        f"ISETP.{kind}.AND P2, PT, RZ, 0x0, PT",
        "VOTEU.ANY UP6, P2",
        "VOTEU.ANY UP5, !P2",
        "VOTEU.ANY UR5, UPT, PT",
    )
    assert (lane.predicates["UP6"], lane.predicates["UP5"]) == (kind == "EQ", kind == "NE")
    assert lane.registers["UR5"] == 1


def test_kinds_of_instructions() -> None:
    code = code_of(
        "LDG.E R4, desc[UR4][R2.64]",
        "IMAD.MOV.U32 R5, RZ, RZ, R4",
        "IMAD R6, R5, R5, RZ",
        "FADD R7, R6, R6",
        "STG.E desc[UR4][R2.64], R7",
    )
    # The threads read and write at address 0, which this memory has.
    memory = EmulatedMemory([(0, np.zeros(COUNT, np.int32))])
    found = issued(code, constants_of(b"", 32, 1), memory, [(0, 0), (1, 0)])
    assert found.kinds == {"loads": 1, "moves": 1, "index": 1, "float": 1, "stores": 1, "jumps": 1}
    assert sum(found.kinds.values()) == found.instructions


def test_generic_addresses_of_the_stack() -> None:
    lines = [
        "LDC R1, c[0x0][0x28]",
        "VIADD R1, R1, 0xfffffff0",  # a frame of 16 bytes
        "ULDC.64 UR6, c[0x0][0x20]",
        "IADD3 R6, P0, R1, UR6, RZ",
        "IADD3.X R7, RZ, UR7, RZ, P0, !PT",
        "MOV R4, 0x2a",
        "STL [R1+0x8], R4",
        "LD.E R5, desc[UR4][R6.64+0x8]",
        "ST.E desc[UR4][R6.64+0xc], R5",
        "LDL R8, [R1+0xc]",
    ]
    first, second = (lane_of(memory_of(np.zeros(COUNT)), *lines) for _ in range(2))
    assert first.registers["R6"] | first.registers["R7"] << 32 == LOCAL_WINDOW + STACK - 16
    assert (first.registers["R5"], first.registers["R8"]) == (42, 42)
    assert (first.accesses, first.waits) == ([], 0)
    assert second.local[STACK - 8] == 42


def test_generic_addresses_of_shared_memory() -> None:
    memory = memory_of(np.zeros(COUNT, np.int32))
    lane = lane_of(
        memory,
        "S2R R7, SR_SWINHI",
        "MOV R6, 0x410",
        "MOV R4, 0x7",
        "ST.E desc[UR4][R6.64], R4",
        "ATOM.E.ADD.STRONG.GPU PT, R8, desc[UR4][R6.64], R4",
        "LDS R5, [0x410]",
        "QSPC.E.S P0, RZ, [R6.64]",
        "QSPC.E.L P1, RZ, [R6.64]",
        "QSPC.E.S P2, RZ, [R2.64]",
    )
    assert lane.registers["R7"] == SHARED_WINDOW >> 32
    assert (lane.registers["R8"], lane.registers["R5"]) == (7, 14)
    assert [lane.predicates[f"P{n}"] for n in range(3)] == [True, False, False]
    assert (lane.accesses, memory.written) == ([], {})


def test_waits_are_those_for_new_lines() -> None:
    lane = lane_of(
        memory_of(np.arange(256, dtype=np.uint32)),
        "LDG.E R4, desc[UR4][R2.64]",  # both lines are loaded before the wait
        "LDG.E R5, desc[UR4][R2.64+0x80]",
        "IADD3 R6, R4, R5, RZ",
        "LDG.E R7, desc[UR4][R2.64+0x4]",  # of a line that is there
        "IADD3 R6, R6, R7, RZ",
        "LDG.E R8, desc[UR4][R2.64+0x100]",  # a value that nothing waits for
    )
    assert lane.registers["R6"] == 0 + 32 + 1
    assert lane.waits == 1


def test_reads_beside_memory_are_zero_and_far_ones_fail() -> None:
    memory = memory_of(np.ones(COUNT, np.uint32))
    assert memory.read(AT - 64, 4) == bytes(4)
    with pytest.raises(KeyError, match="no memory at"):
        memory.read(AT - (1 << 20), 4)


def test_process_memory() -> None:
    memory, values = ProcessMemory(), np.arange(4, dtype=np.uint32)
    assert memory.read(values.ctypes.data + 4, 4) == b"\1\0\0\0"
    memory.write(values.ctypes.data + 4, b"\7")
    assert memory.read(values.ctypes.data + 4, 4) == b"\7\0\0\0"
    assert values[1] == 1
    with pytest.raises(KeyError, match="no memory at"):
        memory.read(16, 4)


def test_parameters_are_aligned() -> None:
    params: list[Any] = [
        ctypes.c_uint32(1),
        ctypes.c_double(2.0),
        ctypes.c_uint8(3),
        ctypes.c_int32(4),
    ]
    assert packed(params) == struct.pack("<I4xdB3xi", 1, 2.0, 3, 4)
