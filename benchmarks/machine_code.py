"""Parser of the machine code of NVIDIA GPUs (SASS of sm_90).

`ptxas` makes the code; `cuobjdump` and `nvdisasm` print it.

The tools are in the extra `ptxas`; no GPU is needed.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

LINE = re.compile(r"^\s+/\*([0-9a-f]{4,})\*/\s+(.*?)\s*;")
GUARD = re.compile(r"@(!?)(U?P\w+)\s+(.*)")


def tool(name: str) -> Path | None:
    """Return the path of a tool of the extra `ptxas`; None if it is not installed."""
    spec = importlib.util.find_spec("nvidia")
    places = [Path(p) for p in (spec.submodule_search_locations or [])] if spec else []
    return next((found for place in places for found in place.glob(f"*/bin/{name}")), None)


def tools_missing() -> list[str]:
    """Return the names of the tools that are not installed."""
    return [name for name in ("ptxas", "cuobjdump", "nvdisasm") if tool(name) is None]


@dataclass(frozen=True)
class Instruction:
    """One instruction: guard, operation with modifiers, operands.

    The guard is a predicate and whether it is negated.
    """

    guard: tuple[str, bool] | None
    name: str
    modifiers: tuple[str, ...]
    operands: tuple[str, ...]
    text: str


@dataclass(frozen=True)
class Kernel:
    """A kernel of a cubin: instructions by address, and registers of a thread."""

    name: str
    code: dict[int, Instruction]
    registers: int
    spilled: int


def assemble(ptx: str, cubin: Path, arch: str = "sm_90") -> list[Kernel]:
    """Assemble PTX to a cubin and return its kernels."""
    ptxas, cuobjdump, nvdisasm = (tool(name) for name in ("ptxas", "cuobjdump", "nvdisasm"))
    assert ptxas and cuobjdump and nvdisasm, tools_missing()
    text = ptx.rstrip("\0 \n") + "\n"  # Warp ends it with a NUL, which ptxas rejects
    process = subprocess.run(
        [ptxas, "-v", f"-arch={arch}", "/dev/stdin", "-o", cubin],
        input=text,
        capture_output=True,
        text=True,
        check=True,
    )
    environment = {
        **os.environ,
        "NVDISASM_PATH": str(nvdisasm.parent),
        "PATH": f"{nvdisasm.parent}{os.pathsep}{os.environ.get('PATH', '')}",
    }
    printed = subprocess.run(
        [cuobjdump, "-sass", cubin], capture_output=True, text=True, check=True, env=environment
    ).stdout
    codes: dict[str, dict[int, Instruction]] = {}
    name = ""
    for line in printed.splitlines():
        if "Function :" in line:
            name = line.split("Function :")[1].strip()
            codes[name] = {}
        elif name and (found := LINE.match(line)):
            codes[name][int(found[1], 16)] = parsed(found[2])
    kernels = []
    for part in re.split(r"Compiling entry function '", process.stderr)[1:]:
        name = part.partition("'")[0]
        registers, spilled = (
            re.search(r"Used (\d+) registers", part),
            re.search(r"(\d+) bytes spill stores", part),
        )
        assert registers, part
        kernels.append(
            Kernel(name, codes[name], int(registers[1]), int(spilled[1]) if spilled else 0)
        )
    return kernels


def parsed(text: str) -> Instruction:
    """Parse the text of an instruction."""
    guard, rest = None, text
    if found := GUARD.match(text):
        guard, rest = (found[2], bool(found[1])), found[3]
    operation, _, operands = rest.partition(" ")
    name, *modifiers = operation.split(".")
    split = re.split(r",\s*(?![^\[]*\])", operands) if operands.strip() else []
    return Instruction(guard, name, tuple(modifiers), tuple(part.strip() for part in split), text)
