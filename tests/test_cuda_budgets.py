"""Registers, stacks and spills of all kernels, by ptxas (extra `ptxas`).

TABLE=path keeps the table, PTX=folder what was compiled. A later run with the same folder compiles
and assembles only what has changed.
"""

import fnmatch
import itertools
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import pytest
import warp as wp

from benchmarks.machine_code import tool, tools_missing
from test_cuda_compiles import compile_for_cuda, modules_of_every_kernel, source_hash

ARCHS = ("sm_80", "sm_90", "sm_100")
REGISTERS = 65536  # registers of all threads of a multiprocessor
# Kernels that may spill, and the reason.
SPILLS = {
    "warp_lcp.blocked_gauss_seidel.*_[56]:*": "a thread enumerates the sets of a block of 5 or 6 "
    "unknowns with its matrix at hand",
    "warp_lcp.coarsest.invert_*": "20 bytes once a solve, in one block",
    "*quads_at1or3_of1or3:*": "36 to 140 bytes on levels with odd rows: the row function is there "
    "for both alignments, in at most 128 registers",
    "warp_lcp.mprgp.split.variable_float64_float32_float64_quads:split": "20 bytes, in float64",
    "warp_lcp.cycle.correct_and_sweep.variable_float64_float64_quads:*": "32 bytes, in float64",
    "warp_lcp.grid.barrier*": "faces, cells and particles beside thin solids only",
    "warp_lcp.grid.thin_walls:stop_kernel": "particles beside thin solids only",
    "fluids.thin_forces:*": "cells beside thin solids only",
    "fluids.wall_drag:*": "cells at walls, if the scene has wall drag",
}
# Kernels with more than 128 registers, so that fewer than 512 threads fit on a multiprocessor, and
# the reason.
LARGE = {
    "warp_lcp.blocked_gauss_seidel.*_[23456]:*": "as above",
    "granular.stress_3d_float64_residual_rate*": "the residual's step with friction that grows "
    "with the rate, in float64",
    "granular.bodies_3d_float64*": "the same at cells that a body touches",
    "granular.report_3d*": "130 on sm_80: what the log tells, once a step",
    "warp_lcp.mprgp.split.variable_float64_float64_float64:split": "an operator in float64 "
    "throughout",
    "granular.packing:contents_kernel": "once a run",
    "warp_lcp.grid.mesh_crossings:find_crossings": "once a mesh",
    "fluids.coupling:*": "bodies' cells only",
    "warp_lcp.small_levels.*": "blocks of 256 threads, which have a multiprocessor each",
    "warp_lcp.grid.barrier*": "faces, cells and particles beside thin solids only",
    "warp_lcp.grid.thin_walls:stop_kernel": "particles beside thin solids only",
    "warp_lcp.grid.distance_advection*": "cells near moving solids only",
    "warp_lcp.grid.node_distance:place": "nodes near solids, when these move",
    "warp_lcp.grid.cut_cells:velocity_kernel": "cut cells only",
    "warp_lcp.grid.particles:total": "once a step, a few thousand threads",
    "warp_lcp.rigid.*": "a thread for each body or pair of bodies",
    "warp_lcp.matrix_stencil.recognize.*": "once a problem",
    "warp_lcp.cycle.correct_and_sweep.variable_float64_float64:*": "in float64",
    "fluids.forces:pressure_kernel": "cells at solids, if forces are logged",
    "fluids.thin_forces:*": "cells beside thin solids only",
    "fluids.wall_drag:*": "cells at walls, if the scene has wall drag",
    "fluids.viscosity_*:force": "cells at solids, if forces are logged",
    "fluids.viscosity_?d:restrict": "142 on sm_80 only; not among the passes that take the time",
    "granular.stress_3d_float32_step*": "up to 140: six stresses and their return to the cone",
    "granular.stress_3d_float64_residual*": "up to 134: the same in float64",
}

# Instructions that passes may issue a cell, of the finer grid of a transfer, on sm_90; variable:
# with fields of weights, as coarser levels have.
ISSUED = {
    "stencil.product uniform": 45,
    "cycle.sweep uniform": 55,
    "cycle.sweep uniform projected": 60,
    "cycle.sweep variable": 55,
    "cycle.sweep variable projected": 60,
    "cycle.two_sweeps uniform": 120,
    "cycle.two_sweeps uniform projected": 140,
    "cycle.two_sweeps variable": 110,
    "cycle.two_sweeps variable projected": 130,
    "cycle.correct_and_sweep uniform": 110,
    "cycle.correct_and_sweep uniform projected": 135,
    "cycle.correct_and_sweep variable": 105,
    "cycle.correct_and_sweep variable projected": 125,
    "cycle.restrict uniform": 30,
    "cycle.restrict variable": 30,
    "cycle.correct uniform": 40,
    "cycle.correct variable": 40,
    "projected_multigrid.update": 60,
    "projected_multigrid.assess uniform": 115,
    "projected_multigrid.assess variable": 130,
    "projected_multigrid.measure uniform": 50,
    "projected_multigrid.measure variable": 50,
}
# Passes that instructions or the L1 cache may hold on an H200: each makes a sweep again for each
# neighbor, and takes less time than the two passes in place of which it is. Bytes hold the others.
JOINED = ("cycle.two_sweeps", "cycle.correct_and_sweep")


def known(kernel: str, among: dict[str, str]) -> bool:
    """Return whether a kernel is in a list of patterns."""
    return any(fnmatch.fnmatchcase(kernel, pattern) for pattern in among)


class KernelResources(NamedTuple):
    """Resources of a kernel on an architecture.

    Registers and bytes are per thread, shared bytes per block.
    """

    kernel: str
    arch: str
    registers: int
    stack: int
    spilled: int
    reloaded: int
    shared: int
    block: int


def compiled(name: str, folder: Path) -> Path:
    """Return the PTX of a module; compile it if its source has changed since it was compiled."""
    mark, source = folder / name / "source.txt", source_hash(name)
    if not mark.exists() or mark.read_text() != source:
        shutil.rmtree(folder / name, ignore_errors=True)
        compile_for_cuda(name, [80], folder / name)
        mark.write_text(source)
    (ptx,) = (folder / name).glob("*.ptx")
    return ptx


def report(ptx: Path, arch: str, text: str) -> str:
    """Assemble PTX; return the report of `ptxas`, which is kept in a file beside the PTX."""
    kept = ptx.with_suffix(f".{arch}.txt")
    if not kept.exists():
        ptxas = tool("ptxas")
        assert ptxas
        done = subprocess.run(
            [ptxas, "-v", f"-arch={arch}", "/dev/stdin", "-o", "/dev/null"],
            input=text,
            capture_output=True,
            text=True,
            check=True,
        )
        kept.write_text(done.stderr)
    return kept.read_text()


def costs(ptx: Path, arch: str) -> list[KernelResources]:
    """Assemble a module; return the resources of its kernels."""
    text = ptx.read_text().rstrip("\0 \n") + "\n"  # Warp ends it with a NUL, which ptxas refuses
    blocks = dict(re.findall(r"\.entry (\w+)\([^{]*?\)\s*(?:\.maxntid (\d+))?", text))
    found = []
    for part in re.split(r"Compiling entry function '", report(ptx, arch, text))[1:]:
        entry = part.partition("'")[0]
        frame = re.search(
            r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", part
        )
        registers, shared = (
            re.search(r"Used (\d+) registers", part),
            re.search(r"(\d+) bytes smem", part),
        )
        assert frame and registers, part
        name = re.sub(r"_[0-9a-f]{8}_cuda_kernel_forward", "", entry)
        numbers = (
            int(registers[1]),
            *map(int, frame.groups()),
            int(shared[1]) if shared else 0,
            int(blocks.get(entry) or 256),
        )
        found.append(KernelResources(f"{ptx.parent.name}:{name}", arch, *numbers))
    return found


def table(rows: list[KernelResources]) -> str:
    """Return a line per kernel.

    Registers on each architecture, other resources on the one where they are largest.
    """
    lines = ["\t".join(["kernel", *ARCHS, *KernelResources._fields[3:]])]
    for kernel, group in itertools.groupby(sorted(rows), key=lambda row: row.kernel):
        by_arch = {row.arch: row for row in group}
        most = (max(values) for values in zip(*(row[3:] for row in by_arch.values()), strict=True))
        lines.append(
            "\t".join(map(str, [kernel, *(by_arch[arch].registers for arch in ARCHS), *most]))
        )
    return "\n".join(lines) + "\n"


@pytest.mark.slow
@pytest.mark.skipif(
    tool("ptxas") is None, reason="nvidia-cuda-nvcc, which has ptxas, is not installed"
)
def test_kernels_stay_within_their_budgets(tmp_path: Path) -> None:
    folder = Path(os.environ.get("PTX", tmp_path))
    names = modules_of_every_kernel((wp.float32, wp.float64))
    modules = [compiled(name, folder) for name in names]
    with ThreadPoolExecutor() as pool:
        rows = [
            row
            for part in pool.map(
                lambda job: costs(*job), [(m, arch) for m in modules for arch in ARCHS]
            )
            for row in part
        ]
    if "TABLE" in os.environ:
        Path(os.environ["TABLE"]).write_text(table(rows))
    for row in rows:
        assert row.registers * row.block <= REGISTERS, row
    spilling, large = (
        {row.kernel for row in rows if row.spilled},
        {row.kernel for row in rows if row.registers > 128},
    )
    assert {kernel for kernel in spilling if not known(kernel, SPILLS)} == set()
    assert {kernel for kernel in large if not known(kernel, LARGE)} == set()
    for among, found in ((SPILLS, spilling), (LARGE, large)):
        # Each exception must be needed.
        assert [pattern for pattern in among if not fnmatch.filter(found, pattern)] == []


@pytest.mark.slow
@pytest.mark.skipif(
    bool(tools_missing()), reason="the extra ptxas, which has the tools, is not installed"
)
def test_passes_issue_few_instructions() -> None:
    command = [sys.executable, "-m", "benchmarks.gpu_model", "--sass"]
    done = subprocess.run(
        command,
        check=True,
        capture_output=True,
        text=True,
        timeout=3600,
        cwd=Path(__file__).parents[1],
    )
    found, limits = defaultdict[str, float](float), defaultdict[str, set[str]](set)
    row = (
        r"^\| `([\w.]+(?: (?:uniform|variable))?)[^`]*?( projected)?` \| ([\d.]+) \|"
        r"(?:[^|]*\|){7} (\w+) \|"
    )
    for one, projected, issued, limit in re.findall(row, done.stdout, re.MULTILINE):
        name = one + projected
        found[name] = max(found[name], float(issued))
        limits[name].add(limit)
    held = {name: limits[name] - {"bytes"} for name in ISSUED if not name.startswith(JOINED)}
    assert {name: limits for name, limits in held.items() if limits} == {}  # on an H200
    assert [
        (name, found[name], most) for name, most in ISSUED.items() if not 0 < found[name] <= most
    ] == []
