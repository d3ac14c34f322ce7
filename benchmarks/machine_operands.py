"""Operands of machine instructions (SASS of sm_90): registers, constants, numbers, addresses."""

from __future__ import annotations

import functools
import re

from benchmarks.machine_code import Instruction


def named(instruction: Instruction) -> frozenset[str]:
    """Return the registers that an instruction names; of 64 bits both halves."""
    found = set[str]()
    for operand in instruction.operands:
        for number in re.findall(r"(?<![A-Z])R(\d+)", operand):
            found |= {f"R{number}", f"R{int(number) + 1}"} if ".64" in operand else {f"R{number}"}
    if instruction.name[:1] == "D":  # numbers in float64 are pairs of registers
        found |= {f"R{int(name[1:]) + 1}" for name in found}
    return frozenset(found)


@functools.cache
def operand_of(text: str) -> tuple[bool, bool, bool, str, str]:
    """Split an operand: negated, inverted, absolute, its kind, and the rest.

    Kinds are register, constant (memory), bits, number, and special (infinite or not a number).
    """
    negative = text.startswith("-") and not re.match(r"-0x|-[\d.]|-INF|-QNAN", text)
    text = text[1:] if negative else text
    inverted = text.startswith("~")
    text = text[1:] if inverted else text
    plain = text.strip("|")
    kinds = {
        r"c\[": "constant",
        r"[+-]?(INF|QNAN)": "special",
        "-?0x": "bits",
        r"[+-]?\d": "number",
    }
    kind = next((kind for form, kind in kinds.items() if re.match(form, plain)), "register")
    return negative, inverted, text.startswith("|"), kind, plain


@functools.cache
def constant_at(operand: str) -> tuple[int, tuple[str, ...]]:
    """Return the offset of an operand in constant memory, and registers to add to it."""
    found = re.match(r"c\[0x[0-9a-f]+\]\s*\[(.+?)\]$", operand)
    assert found, operand
    parts = [part.strip() for part in found[1].split("+")]
    numbers = [int(part, 16) for part in parts if part.startswith("0x")]
    return sum(numbers), tuple(part for part in parts if not part.startswith("0x"))


@functools.cache
def pair_of(register: str) -> tuple[str, str]:
    """Return the names of the two registers of 64 bits; empty names for the register zero."""
    if register.startswith(("RZ", "URZ")):
        return "", ""
    found = re.match(r"(U?R)(\d+)", register)
    assert found, register
    return f"{found[1]}{found[2]}", f"{found[1]}{int(found[2]) + 1}"


@functools.cache
def address_of(operand: str) -> tuple[int, tuple[tuple[str, str, int], ...]]:
    """Split an address: its number, and terms of a kind, a register and a factor."""
    found = re.search(r"\[([^\[\]]*)\]$", operand)
    assert found, operand
    number, terms = 0, []
    for part in (p.strip() for p in found[1].split("+")):
        if re.match(r"-?0x", part):
            number += int(part, 16)
        elif part.endswith(".64") or (part.startswith("UR") and "desc" in operand):
            terms.append(("long", part.replace(".64", ""), 1))
        elif scaled := re.search(r"\.X(\d+)$", part):
            terms.append(("scaled", part, int(scaled[1])))
        else:
            terms.append(("signed", part, 1))
    return number, tuple(terms)


def wide_address(operand: str) -> str:
    """Mark the register of an address of 64 bits where the text of the instruction does not.

    An instruction with the modifier E has such an address, even if it is printed as `[R16+0x8]`.
    """
    return re.sub(r"^\[(R\d+)(?=[+\]])", r"[\1.64", operand)
