"""Emulator of a GPU thread's machine code (SASS of sm_90) on the host.

It works on copies of the device's memory. Atomics take effect in the order in which threads are
executed. Shuffles and votes, which need other threads, see the thread alone.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from benchmarks.machine_code import Instruction
from benchmarks.machine_memory import LOCAL_WINDOW, SHARED_WINDOW, EmulatedMemory
from benchmarks.machine_operands import (
    address_of,
    constant_at,
    named,
    operand_of,
    pair_of,
    wide_address,
)

LOW, ALL = 0xFFFFFFFF, (1 << 64) - 1
MOST = 200_000  # most instructions of a lane
PREDICATE = re.compile(r"U?P(\d|T)$")
NO_VALUE = "NOP BSSY BSYNC WARPSYNC BREAK BMOV YIELD DEPBAR BAR MEMBAR ERRBAR CCTL"
IGNORED = frozenset(NO_VALUE.split())
LINE = 128  # bytes of a line of the cache
COMPARED: dict[str, Callable[[float, float], bool]] = {  # a second letter U: true for NaN
    "MIN": lambda a, b: a < b or b != b,  # of two numbers, the one that is not NaN
    "MAX": lambda a, b: a > b or b != b,
    "LT": lambda a, b: a < b,
    "EQ": lambda a, b: a == b,
    "LE": lambda a, b: a <= b,
    "GT": lambda a, b: a > b,
    "NE": lambda a, b: a != b and a == a and b == b,
    "GE": lambda a, b: a >= b,
    "NUM": lambda a, b: a == a and b == b,
    "NAN": lambda a, b: a != a or b != b,
    "LTU": lambda a, b: not a >= b,
    "EQU": lambda a, b: a == b or a != a or b != b,
    "LEU": lambda a, b: not a > b,
    "GTU": lambda a, b: not a <= b,
    "NEU": lambda a, b: a != b,
    "GEU": lambda a, b: not a < b,
}


class DecodedInstruction(NamedTuple):
    """Instruction with the method that executes it.

    Attributes:
        instruction: itself.
        execute: method of `Lane`; it returns the next address if it jumps.
        modifiers: of the operation.
        operands: of the instruction.
        names: registers that it names.
        after: address of the instruction after it.
    """

    instruction: Instruction
    execute: Callable[[Lane, set[str], list[str], Instruction], int | None]
    modifiers: set[str]
    operands: list[str]
    names: frozenset[str]
    after: int


Program = dict[int, DecodedInstruction]


def _signed(value: int, bits: int = 32) -> int:
    return value - (1 << bits) if value >> (bits - 1) & 1 else value


def _float(bits: int) -> float:
    return float(struct.unpack("<f", struct.pack("<I", bits & LOW))[0])


def _double(bits: int) -> float:
    return float(struct.unpack("<d", struct.pack("<Q", bits & ALL))[0])


def _bits(value: float) -> int:
    return int(np.float32(value).view(np.uint32))


def _long_bits(value: float) -> int:
    return int(struct.unpack("<Q", struct.pack("<d", float(value)))[0])


def _half_bits(value: float) -> int:
    return int(np.float16(value).view(np.uint16))


def _changed(old: int, operand: int, m: set[str], i: Instruction) -> int:
    """Return what an atomic instruction makes of the bits of a value in memory."""
    if m & {"F64", "F32"}:
        real, bits = (_double, _long_bits) if "F64" in m else (_float, _bits)
        if "ADD" in m:
            return bits(real(old) + real(operand))
        raise NotImplementedError(i.text)
    size = 64 if "64" in m else 32
    number = (lambda v: _signed(v, size)) if m & {"S32", "S64"} else (lambda v: v)
    of: dict[str, Callable[[], int]] = {
        "ADD": lambda: old + operand,
        "MIN": lambda: min(old, operand, key=number),
        "MAX": lambda: max(old, operand, key=number),
        "AND": lambda: old & operand,
        "OR": lambda: old | operand,
        "XOR": lambda: old ^ operand,
        "EXCH": lambda: operand,
    }
    for name, change in of.items():
        if name in m:
            return change()
    raise NotImplementedError(i.text)


def decoded(code: dict[int, Instruction]) -> Program:
    """Return the steps of a kernel by address."""
    following = dict(itertools.pairwise(sorted(code)))
    program: Program = {}
    for at, one in code.items():
        # The uniform datapath has the same operations.
        plain = one.name[1:] if one.name[0] == "U" else one.name
        alias = "nothing" if one.name in IGNORED else ALIASES.get(plain, plain)
        execute = getattr(Lane, f"_do_{alias.lower()}", Lane._fail)
        if "E" in one.modifiers:
            one = replace(one, operands=tuple(wide_address(part) for part in one.operands))
        program[at] = DecodedInstruction(
            one, execute, set(one.modifiers), list(one.operands), named(one), following.get(at, at)
        )
    return program


@dataclass
class Lane:
    """State of a thread that executes a kernel."""

    code: dict[int, Instruction]
    constants: bytes
    memory: EmulatedMemory
    thread: int
    block: int
    registers: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    predicates: dict[str, bool] = field(
        default_factory=lambda: defaultdict(bool, PT=True, UPT=True)
    )
    count: Counter[int] = field(default_factory=Counter)  # executions by address of the instruction
    waits: int = 0  # for loads of lines that the thread has not loaded before
    pending: set[str] = field(default_factory=set)  # registers of loads that none has waited for
    lines: set[int] = field(default_factory=set)  # lines of memory that have been loaded
    far: bool = False  # whether a pending load reads a line for the first time
    # Each access: instruction, how often it was executed before, address, bytes, whether it is a
    # load.
    accesses: list[tuple[int, int, int, int, bool]] = field(default_factory=list)
    local: dict[int, int] = field(default_factory=dict)  # local memory, by address
    at: int = 0

    program: Program | None = None  # the code, decoded; None: decoded at the start

    def run(self) -> None:
        """Execute the kernel until it ends."""
        program = self.program or decoded(self.code)
        at, count, predicates = min(self.code), self.count, self.predicates
        with np.errstate(all="ignore"):
            for _ in range(MOST):
                instruction, execute, modifiers, operands, names, after = program[at]
                count[at] += 1
                target: int | None = None
                guard = instruction.guard
                if guard is None or predicates[guard[0]] != guard[1]:
                    if instruction.name == "EXIT":
                        return
                    if self.pending and not self.pending.isdisjoint(names):
                        self.waits += self.far
                        self.far = False
                        self.pending.clear()
                    self.at = at
                    target = execute(self, modifiers, operands, instruction)
                at = after if target is None else target
        raise RuntimeError(f"a lane executes more than {MOST} instructions")

    # Jumps: they return the next address.

    def _do_bra(self, m: set[str], o: list[str], i: Instruction) -> int | None:
        return int(o[-1], 16) if len(o) == 1 or self._predicate(o[0]) else None

    def _do_call(self, m: set[str], o: list[str], i: Instruction) -> int:
        return int(o[-1], 16)

    def _do_ret(self, m: set[str], o: list[str], i: Instruction) -> int:
        register, offset = o[0].split()
        return (self._long(register) + int(offset, 16)) & LOW

    def _do_nothing(self, m: set[str], o: list[str], i: Instruction) -> None:
        pass

    def _fail(self, m: set[str], o: list[str], i: Instruction) -> None:
        raise NotImplementedError(i.text)

    # Operands.

    def _register(self, name: str) -> int:
        plain = name.partition(".")[0]
        return 0 if plain in ("RZ", "URZ", "SRZ") else self.registers[plain]

    def _constant(self, operand: str, size: int) -> int:
        offset, registers = constant_at(operand)
        offset += sum(self._register(name) for name in registers)
        return int.from_bytes(self.constants[offset : offset + size], "little")

    def _int(self, operand: str) -> int:
        value = self.registers.get(operand)  # a plain register, written before
        if value is not None:
            return value
        negative, inverted, _, kind, plain = operand_of(operand)
        if kind == "register":
            value = self._register(plain) >> (16 if ".H1" in plain else 0)
        elif kind == "constant":
            value = self._constant(plain, 4)
        else:
            value = (int(plain, 16) if kind == "bits" else int(float(plain))) & LOW
        value = ~value & LOW if inverted else value
        return -value & LOW if negative else value

    def _long(self, operand: str) -> int:
        negative, _, _, kind, plain = operand_of(operand)
        if kind == "register":
            low, high = pair_of(plain)
            value = self.registers[low] | self.registers[high] << 32 if low else 0
        else:
            value = self._constant(plain, 8) if kind == "constant" else int(plain, 16)
        return -value & ALL if negative else value

    def _real(self, operand: str, *, double: bool = False) -> float:
        negative, _, absolute, kind, plain = operand_of(operand)
        if kind == "register":
            value = _double(self._long(plain)) if double else _float(self._register(plain))
        elif kind == "constant":
            value = (
                _double(self._constant(plain, 8)) if double else _float(self._constant(plain, 4))
            )
        elif kind == "special":
            value = (
                (-math.inf if plain.startswith("-") else math.inf) if "INF" in plain else math.nan
            )
        else:
            value = _float(int(plain, 16)) if kind == "bits" else float(plain)
        value = abs(value) if absolute else value
        return -value if negative else value

    def _double_real(self, operand: str) -> float:
        return self._real(operand, double=True)

    def _predicate(self, operand: str) -> bool:
        return (
            not self._predicate(operand[1:])
            if operand.startswith("!")
            else self.predicates[operand]
        )

    def _put(self, register: str, value: int) -> None:
        plain = register.partition(".")[0]
        if plain not in ("RZ", "URZ"):
            self.registers[plain] = value & LOW

    def _put_long(self, register: str, value: int) -> None:
        low, high = pair_of(register)
        if low:
            self.registers[low], self.registers[high] = value & LOW, value >> 32 & LOW

    def _set(self, predicate: str, value: object) -> None:
        if predicate not in ("PT", "UPT"):
            self.predicates[predicate] = bool(value)

    def _address(self, operand: str) -> int:
        address, terms = address_of(operand)
        for kind, name, factor in terms:
            if kind == "long":
                address += self._long(name)
            elif kind == "scaled":
                address += self._register(name) * factor
            else:
                address += _signed(self._register(name))
        return address & ALL

    @staticmethod
    def _predicate_first(operands: list[str]) -> str | None:
        """Split a leading predicate from the operands.

        The predicate is None if there is none.
        """
        return operands.pop(0) if PREDICATE.match(operands[0]) else None

    # Moves.

    def _do_s2r(self, m: set[str], o: list[str], i: Instruction) -> None:
        which = {
            "SR_TID.X": self.thread,
            "SR_CTAID.X": self.block,
            "SR_LANEID": self.thread % 32,
            "SR_SWINHI": SHARED_WINDOW >> 32,
        }
        self._put(o[0], which.get(o[1], 0))

    def _do_cs2r(self, m: set[str], o: list[str], i: Instruction) -> None:
        (self._put if "32" in m else self._put_long)(o[0], 0)

    def _do_ldc(self, m: set[str], o: list[str], i: Instruction) -> None:
        size = 8 if "64" in m else 1 if m & {"U8", "S8"} else 2 if m & {"U16", "S16"} else 4
        (self._put_long if size == 8 else self._put)(o[0], self._constant(o[1], size))

    def _do_mov(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], self._int(o[-1]))

    def _do_r2ur(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], self._int(o[1]))

    def _do_sel(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], self._int(o[1] if self._predicate(o[3]) else o[2]))

    def _do_fsel(self, m: set[str], o: list[str], i: Instruction) -> None:
        operand = o[1] if self._predicate(o[3]) else o[2]
        # Upper halves of infinite doubles are printed like this.
        halves = {"+QNAN": 0x7FF00000, "-QNAN": 0xFFF00000, "QNAN": 0x7FF00000}
        negative, _, absolute, _, plain = operand_of(operand)
        if operand in halves:
            bits = halves[operand]
        elif plain.startswith("R"):
            bits = self._register(plain) & (0x7FFFFFFF if absolute else LOW) ^ (
                0x80000000 if negative else 0
            )
        else:
            bits = _bits(self._real(operand))
        self._put(o[0], bits)

    def _do_prmt(self, m: set[str], o: list[str], i: Instruction) -> None:
        both, chosen, value = self._int(o[3]) << 32 | self._int(o[1]), self._int(o[2]), 0
        for k in range(4):
            which = chosen >> 4 * k & 15
            byte = both >> 8 * (which & 7) & 255
            value |= ((255 if byte & 128 else 0) if which & 8 else byte) << 8 * k
        self._put(o[0], value)

    def _do_p2r(self, m: set[str], o: list[str], i: Instruction) -> None:
        mask, kind = self._int(o[3]), o[1].removesuffix("R")
        value = sum(self.predicates[f"{kind}{n}"] << n for n in range(7))
        self._put(o[0], self._int(o[2]) & ~mask | value & mask)

    def _do_r2p(self, m: set[str], o: list[str], i: Instruction) -> None:
        value, mask = self._int(o[1]) >> (8 * int(o[1][-1]) if ".B" in o[1] else 0), self._int(o[2])
        kind = o[0].removesuffix("R")
        for n in range(7):
            if mask >> n & 1:
                self.predicates[f"{kind}{n}"] = bool(value >> n & 1)

    def _do_shfl(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._set(o[0], True)
        self._put(o[1], self._int(o[2]))

    def _do_redux(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], self._int(o[1]))

    def _do_vote(self, m: set[str], o: list[str], i: Instruction) -> None:
        for operand in o[:-1]:
            if re.match(r"U?R\d", operand):
                self._put(operand, 1)
            elif PREDICATE.match(operand):
                self._set(operand, "EQ" in m or self._predicate(o[-1]))

    # Integers.

    def _do_iadd3(self, m: set[str], o: list[str], i: Instruction) -> None:
        carries, rest = [], o[1:]
        while PREDICATE.match(rest[0]):
            carries.append(rest.pop(0))
        total = sum(self._predicate(p) for p in rest[3:]) if "X" in m else 0
        # A negated operand is inverted, and 1 is added, so that the carry is that of the sum.
        for operand in rest[:3]:
            negated = operand.startswith("-") and not operand.startswith("-0x")
            total += (~self._int(operand[1:]) & LOW) + 1 if negated else self._int(operand)
        for n, predicate in enumerate(carries[:2], 1):
            self._set(predicate, total >> 32 >= n)
        self._put(o[0], total)

    def _do_viadd(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], self._int(o[1]) + self._int(o[2]))

    def _do_imad(self, m: set[str], o: list[str], i: Instruction) -> None:
        rest = o[1:]
        carry_out = self._predicate_first(rest)
        if "MOV" in m:
            self._put(o[0], self._int(rest[2]))
            return
        if "SHL" in m or "IADD" in m or not m & {"WIDE", "HI"}:
            carry = self._predicate(rest[3]) if "X" in m and len(rest) > 3 else 0
            self._put(o[0], self._int(rest[0]) * self._int(rest[1]) + self._int(rest[2]) + carry)
            return
        a, b = self._int(rest[0]), self._int(rest[1])
        a, b = (a, b) if "U32" in m else (_signed(a), _signed(b))
        value = (
            (a * b & ALL)
            + self._long(rest[2])
            + (self._predicate(rest[3]) if "X" in m and len(rest) > 3 else 0)
        )
        if carry_out:
            self._set(carry_out, value >> 64)
        if "WIDE" in m:
            self._put_long(o[0], value)
        else:
            self._put(o[0], value >> 32)

    def _do_lea(self, m: set[str], o: list[str], i: Instruction) -> None:
        rest = o[1:]
        carry_out = self._predicate_first(rest)
        if "HI" in m:
            low, added = self._int(rest[0]), self._int(rest[1])
            if "SX32" in m:
                high, shift, carry = (LOW if low >> 31 else 0), self._int(rest[2]), rest[3:]
            else:
                high, shift, carry = self._int(rest[2]), self._int(rest[3]), rest[4:]
            value = (
                (((high << 32 | low) << shift) >> 32 & LOW)
                + added
                + (self._predicate(carry[0]) if "X" in m and carry else 0)
            )
        else:
            value = (self._int(rest[0]) << self._int(rest[2]) & LOW) + self._int(rest[1])
        if carry_out:
            self._set(carry_out, value >> 32)
        self._put(o[0], value)

    def _do_shf(self, m: set[str], o: list[str], i: Instruction) -> None:
        low, shift, high = self._int(o[1]), self._int(o[2]), self._int(o[3])
        shift = shift & 63 if m & {"U64", "S64"} else shift & 31 if "W" in m else min(shift, 32)
        both = high << 32 | low
        if "L" in m:
            value = (both << shift) >> 32 if "HI" in m else low << shift
        elif "HI" in m and m & {"S32", "U32"}:
            value = (_signed(high) if "S32" in m else high) >> shift
        else:
            value = (_signed(both, 64) if "S64" in m else both) >> shift
            value = value >> 32 if "HI" in m else value
        self._put(o[0], value)

    def _do_shl(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], self._int(o[1]) << self._int(o[2]))

    def _do_lop3(self, m: set[str], o: list[str], i: Instruction) -> None:
        rest = o[:]
        predicate = self._predicate_first(rest)
        a, b, c, table = (self._int(operand) for operand in rest[1:5])
        value = 0
        for bit in range(8):
            if table >> bit & 1:
                value |= (a if bit & 4 else ~a) & (b if bit & 2 else ~b) & (c if bit & 1 else ~c)
        if predicate:
            self._set(predicate, value & LOW)
        self._put(rest[0], value)

    def _do_plop3(self, m: set[str], o: list[str], i: Instruction) -> None:
        place = self._predicate(o[2]) << 2 | self._predicate(o[3]) << 1 | self._predicate(o[4])
        self._set(o[0], self._int(o[5]) >> place & 1)
        self._set(o[1], self._int(o[6]) >> place & 1 if len(o) > 6 else 0)

    def _do_isetp(self, m: set[str], o: list[str], i: Instruction) -> None:
        kind = i.modifiers[0]
        a, b = self._int(o[2]), self._int(o[3])
        a, b = (a, b) if "U32" in m else (_signed(a), _signed(b))
        result = COMPARED[kind](a, b)
        if "EX" in m:  # the upper halves of two numbers; the predicate is that of the lower ones
            low = self._predicate(o[5])
            result = low if a == b and kind != "NE" else (result or low) if kind == "NE" else result
        self._set_both(m, o, result)

    def _set_both(self, m: set[str], o: list[str], result: bool) -> None:
        other = self._predicate(o[4])
        for predicate, value in ((o[0], result), (o[1], not result)):
            self._set(
                predicate,
                (value and other)
                if "AND" in m
                else (value or other)
                if "OR" in m
                else value != other,
            )

    def _do_vimnmx(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._least_or_most(m, self._int(o[1]), self._int(o[2]), o)

    def _do_vimnmx3(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._least_or_most(m, self._int(o[1]), self._int(o[2]), o)
        self._least_or_most(m, self._int(o[0]), self._int(o[3]), o)

    def _do_viaddmnmx(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._least_or_most(m, (self._int(o[1]) + self._int(o[2])) & LOW, self._int(o[3]), o)

    def _least_or_most(self, m: set[str], a: int, b: int, o: list[str]) -> None:
        a, b = (a, b) if "U32" in m else (_signed(a), _signed(b))
        value = min(a, b) if self._predicate(o[-1]) else max(a, b)
        self._put(o[0], max(value, 0) if "RELU" in m else value)

    def _do_iabs(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], abs(_signed(self._int(o[1]))))

    def _do_popc(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], self._int(o[1]).bit_count())

    # Floating-point numbers.

    # The compiler uses it to load two halves.
    def _do_hfma2(self, m: set[str], o: list[str], i: Instruction) -> None:
        if o[1] != "-RZ":
            raise NotImplementedError(i.text)
        self._put(o[0], _half_bits(self._real(o[3])) << 16 | _half_bits(self._real(o[4])))

    def _do_fadd(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], _bits(self._real(o[1]) + self._real(o[2])))

    def _do_fmul(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], _bits(self._real(o[1]) * self._real(o[2])))

    def _do_ffma(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], _bits(self._real(o[1]) * self._real(o[2]) + self._real(o[3])))

    def _do_fmnmx(self, m: set[str], o: list[str], i: Instruction) -> None:
        a, b = self._real(o[1]), self._real(o[2])
        self._put(o[0], _bits(min(a, b) if self._predicate(o[3]) else max(a, b)))

    def _do_dadd(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put_long(o[0], _long_bits(self._double_real(o[1]) + self._double_real(o[2])))

    def _do_dmul(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put_long(
            o[0], _long_bits(np.float64(self._double_real(o[1])) * self._double_real(o[2]))
        )

    def _do_dfma(self, m: set[str], o: list[str], i: Instruction) -> None:  # rounded twice
        self._put_long(
            o[0],
            _long_bits(
                np.float64(self._double_real(o[1])) * self._double_real(o[2])
                + self._double_real(o[3])
            ),
        )

    def _do_dmnmx(self, m: set[str], o: list[str], i: Instruction) -> None:
        a, b = self._double_real(o[1]), self._double_real(o[2])
        self._put_long(o[0], _long_bits(min(a, b) if self._predicate(o[3]) else max(a, b)))

    def _do_fsetp(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._set_both(m, o, COMPARED[i.modifiers[0]](self._real(o[2]), self._real(o[3])))

    def _do_fset(self, m: set[str], o: list[str], i: Instruction) -> None:
        kind, other = i.modifiers[1 if "BF" in m else 0], self._predicate(o[3])
        result = COMPARED[kind](self._real(o[1]), self._real(o[2])) and other
        if "AND" not in m:
            raise NotImplementedError(i.text)
        self._put(o[0], (_bits(1.0) if "BF" in m else LOW) if result else 0)

    def _do_dsetp(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._set_both(
            m, o, COMPARED[i.modifiers[0]](self._double_real(o[2]), self._double_real(o[3]))
        )

    def _do_fchk(self, m: set[str], o: list[str], i: Instruction) -> None:
        """Set a predicate where a division needs the slow path."""
        a, b = (_bits(self._real(operand)) >> 23 & 255 for operand in o[1:3])
        usual = self._real(o[1]) == 0 or (1 < b < 252 and 24 < a < 255 and -126 < a - b < 127)
        self._set(o[0], not usual)

    def _do_mufu(self, m: set[str], o: list[str], i: Instruction) -> None:
        if m & {"RCP64H", "RSQ64H"}:  # of the upper half of a number in float64
            high = np.float64(_double(self._int(o[1]) << 32))
            found = 1 / (high if "RCP64H" in m else np.sqrt(high))
            self._put(o[0], _long_bits(found) >> 32)
            return
        value = np.float64(self._real(o[1]))
        functions: dict[str, Callable[[np.float64], np.float64]] = {
            "RCP": lambda v: 1 / v,
            "RSQ": lambda v: 1 / np.sqrt(v),
            "SQRT": np.sqrt,
            "EX2": np.exp2,
            "LG2": np.log2,
        }
        self._put(o[0], _bits(functions[i.modifiers[0]](value)))

    def _do_f2f(self, m: set[str], o: list[str], i: Instruction) -> None:
        if i.modifiers[-2:] == ("F32", "F64"):
            self._put(o[0], _bits(self._double_real(o[1])))
        elif i.modifiers[-2:] == ("F64", "F32"):
            self._put_long(o[0], _long_bits(self._real(o[1])))
        else:
            raise NotImplementedError(i.text)

    def _do_i2fp(self, m: set[str], o: list[str], i: Instruction) -> None:
        value = self._int(o[1])
        self._put(o[0], _bits(value if "U32" in m else _signed(value)))

    def _do_i2f(self, m: set[str], o: list[str], i: Instruction) -> None:
        part = o[1].split(".")[1] if "." in o[1] and o[1].startswith("R") else ""
        if m & {"U64", "S64"}:
            value = self._long(o[1]) if "U64" in m else _signed(self._long(o[1]), 64)
        else:
            value = self._int(o[1].split(".")[0] if part else o[1])
            value = value >> 8 * int(part[1]) & 255 if part.startswith("B") else value
            value = (
                value & 255
                if "U8" in m
                else value & 65535
                if "U16" in m
                else value
                if "U32" in m
                else _signed(value)
            )
        if "F64" in m:
            self._put_long(o[0], _long_bits(value))
            return
        rounded = np.float32(value)
        if "RP" in m and float(rounded) < value:
            rounded = np.nextafter(rounded, np.float32(np.inf))
        self._put(o[0], _bits(float(rounded)))

    def _do_f2i(self, m: set[str], o: list[str], i: Instruction) -> None:
        real = self._double_real(o[1]) if "F64" in m else self._real(o[1])
        value = 0 if real != real else int(max(min(real, 2.0**64), -(2.0**63)))
        if m & {"U64", "S64"}:
            self._put_long(o[0], max(0, min(value, ALL)) if "U64" in m else value & ALL)
        else:
            self._put(
                o[0],
                min(max(value, 0), LOW)
                if "U32" in m
                else max(min(value, (1 << 31) - 1), -(1 << 31)),
            )

    def _do_f2fp(self, m: set[str], o: list[str], i: Instruction) -> None:
        self._put(o[0], _half_bits(self._real(o[1])) << 16 | _half_bits(self._real(o[2])))

    # Memory.

    @staticmethod
    def _size(m: set[str]) -> int:
        return (
            16
            if "128" in m
            else 8
            if "64" in m
            else 1
            if m & {"U8", "S8"}
            else 2
            if m & {"U16", "S16"}
            else 4
        )

    def _own(self, name: str, address: int) -> dict[int, int] | None:
        """Return the local or shared memory that an access reaches; None if it is global.

        Generic accesses reach local and shared memory by addresses in their windows.
        """
        window = address >> 32 << 32
        if name in ("LDL", "STL") or window == LOCAL_WINDOW:
            return self.local
        if name in ("LDS", "STS", "ATOMS") or window == SHARED_WINDOW:
            return self.memory.shared
        return None

    def _do_qspc(self, m: set[str], o: list[str], i: Instruction) -> None:
        """Set a predicate where a generic address is one of shared (S) or local (L) memory."""
        window = self._address(o[-1]) >> 32 << 32
        self._set(o[0], window == (SHARED_WINDOW if "S" in m else LOCAL_WINDOW))

    def _do_load(self, m: set[str], o: list[str], i: Instruction) -> None:
        address, size = (
            self._address(next(operand for operand in o[1:] if "[" in operand)),
            self._size(m),
        )
        own = self._own(i.name, address)
        if own is not None:
            data = bytes(own.get((address + k) & LOW, 0) for k in range(size))
        else:
            data = self.memory.read(address, size)
            self.accesses.append((self.at, self.count[self.at], address, size, True))
            self._await(o[0], address, max(size // 4, 1))
        value = int.from_bytes(data, "little")
        if size < 4:
            self._put(o[0], _signed(value, 8 * size) if m & {"S8", "S16"} else value)
        elif (register := o[0].split(".")[0]) != "RZ":
            for k in range(0, size, 4):
                self.registers[f"R{int(register[1:]) + k // 4}"] = value >> 8 * k & LOW

    def _await(self, register: str, address: int, count: int) -> None:
        """Note that registers hold what is loaded only after a wait."""
        if found := re.match(r"R(\d+)", register):
            self.pending |= {f"R{int(found[1]) + k}" for k in range(count)}
            self.far = self.far or address // LINE not in self.lines
            self.lines.add(address // LINE)

    def _do_atomic(self, m: set[str], o: list[str], i: Instruction) -> None:
        """Change memory; the value before goes to a register, but for reductions."""
        wide = "64" in m or "F64" in m
        place = next(n for n, operand in enumerate(o) if "[" in operand)
        address, size, values = self._address(o[place]), 8 if wide else 4, o[place + 1 :]
        take, own = self._long if wide else self._int, self._own(i.name, address)
        if own is not None:
            data = bytes(own.get((address + k) & LOW, 0) for k in range(size))
        else:
            data = self.memory.read(address, size)
            self.accesses.append((self.at, self.count[self.at], address, size, False))
        old = int.from_bytes(data, "little")
        if i.name.startswith("ATOM") and place:
            (self._put_long if wide else self._put)(o[place - 1], old)
            if own is None:
                self._await(o[place - 1], address, size // 4)
            # Whether the unit of global memory has done it; otherwise code after it does.
            if place > 1 and PREDICATE.match(o[0]):
                self._set(o[0], True)
        if m & {"CAS", "CAST"}:
            new = take(values[1]) if old == take(values[0]) else old
        elif m >= {"POPC", "INC"}:  # counts the threads that execute it
            new = old + 1
        else:
            new = _changed(old, take(values[0]), m, i)
        stored = (new & (ALL if wide else LOW)).to_bytes(size, "little")
        if own is not None:
            own.update(((address + k) & LOW, byte) for k, byte in enumerate(stored))
        else:
            self.memory.write(address, stored)

    def _do_store(self, m: set[str], o: list[str], i: Instruction) -> None:
        address, size, register = (
            self._address(next(operand for operand in o if "[" in operand)),
            self._size(m),
            o[-1].split(".")[0],
        )
        words = [
            0 if register == "RZ" else self.registers[f"R{int(register[1:]) + k}"]
            for k in range(max(size // 4, 1))
        ]
        data = b"".join(word.to_bytes(4, "little") for word in words)[:size]
        own = self._own(i.name, address)
        if own is not None:
            own.update(((address + k) & LOW, byte) for k, byte in enumerate(data))
        else:
            self.memory.write(address, data)
            self.accesses.append((self.at, self.count[self.at], address, size, False))


ALIASES = {
    "RED": "atomic",
    "REDG": "atomic",
    "ATOM": "atomic",
    "ATOMG": "atomic",
    "ATOMS": "atomic",
    "S2UR": "S2R",
    "P2UR": "P2R",
    "R2UP": "R2P",
    "VOTEU": "VOTE",
    "LDG": "load",
    "LD": "load",
    "LDS": "load",
    "LDL": "load",
    "STG": "store",
    "ST": "store",
    "STS": "store",
    "STL": "store",
    "IMNMX": "VIMNMX",
    "IMOV": "MOV",
}
