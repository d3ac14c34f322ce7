# mypy: ignore-errors
"""Residuals in pairs of float32: accuracy, and estimated time on an RTX 4090.

Run `python -m benchmarks.two_floats` in the source tree.

Consumer GPUs compute in float64 at 1/64 of the rate of float32. Here the natural residual of a
splash at solutions by projected multigrid is evaluated on the CPU in genuine float32. x and b are
sums of two float32 (48 bits). All arithmetic is on such pairs, on differences of them, or on their
first halves alone. `longdouble` is NumPy's and uses no code of these kernels. A floor is the error
of an evaluation. The instructions of a cell are counted in PTX, compiled without a GPU; times
follow from data sheets. Nothing here has been measured on a GPU.
"""

import re
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import warp as wp
from warp._src.context import user_modules

import warp_lcp as wl
from warp_lcp.benchmarks.problems import Splash, natural, splash
from warp_lcp.kernels.kernel_variant import C
from warp_lcp.kernels.layout import make_struct, put
from warp_lcp.kernels.vectors import CUDA_BLOCK

# Of an RTX 4090: clock [Hz], and bandwidth of streaming kernels [byte/s].
ARCH, MULTIPROCESSORS, CLOCK, BANDWIDTH = 89, 128, 2.52e9, 0.8 * 1008e9
# Instructions per multiprocessor and cycle; conversions of float64 take as long.
RATE = {"f64": 2, "f32": 128}
RECIPROCAL = 5  # instructions of float64 into which ptxas expands `rcp.rn.f64`
# Bytes of a cell: x b unknown d free g code; x z q code.
BYTES = {"assess": 8 + 8 + 1 + 1 + 1 + 4 + 1, "update": 16 + 4 + 8 + 1}
KINDS = {
    "add, mul, fma": "add sub mul fma",
    "compare": "min max setp",
    "convert": "cvt",
    "1/x": "rcp",
    "others": "div sqrt",
}
DRAWN = 40  # problems
SIZES, TOLERANCES, CELLS = (32, 64, 128), (1e-6, 1e-8, 1e-10, 1e-12, 1e-15), 256

PAIRS = """
#ifndef __CUDA_ARCH__
#define __fmul_rn(a, b) ((a)*(b))
#pragma clang fp contract(off) reassociate(off)
#endif
struct Two { float hi, lo; };
const auto sum = [](float a, float b) -> Two {
    const float s = a + b, t = s - a;
    return {s, (a - (s - t)) + (b - t)};
};
const auto quick = [](float a, float b) -> Two {  // |a| >= |b|
    const float s = a + b;
    return {s, b - (s - a)};
};
const auto product = [](float a, float b) -> Two {
    const float p = __fmul_rn(a, b);
    return {p, fmaf(a, b, -p)};
};
const auto scaled = [&](float a, Two b) -> Two {
    const Two p = product(a, b.hi);
    return quick(p.hi, fmaf(a, b.lo, p.lo));
};
const auto add = [&](Two a, Two b) -> Two {
    const Two s = sum(a.hi, b.hi), t = sum(a.lo, b.lo), u = quick(s.hi, s.lo + t.hi);
    return quick(u.hi, u.lo + t.lo);
};
"""
# y = e x - sum of w x_neighbor + b, with weights and bounds in float32.
PLAIN = """
const auto gap = [&](F to) { return hi[c] - to; };
const F y = e*hi[c]
    - (cx*(hi[c-1] + hi[c+1]) + cy*(hi[c-row] + hi[c+row]) + cz*(hi[c-plane] + hi[c+plane]))
    + b_hi[c];
"""
TWO = """
const auto gap = [&](float to) { return (hi[c] - to) + lo[c]; };
const auto x = [&](int at) -> Two { return {hi[at], lo[at]}; };
const auto axis = [&](float w, int step) { return scaled(-w, add(x(c - step), x(c + step))); };
const Two neighbors = add(add(axis(cx, 1), axis(cy, row)), axis(cz, plane));
const Two all = add(add(scaled(e, x(c)), neighbors), Two{b_hi[c], b_lo[c]});
const float y = all.hi + all.lo;
"""
DIFFERENCES = """
const auto gap = [&](float to) { return (hi[c] - to) + lo[c]; };
float v = 0, rest = e;  // of e: faces to air
const auto beside = [&](float open, int at) {
    v += open*((hi[c] - hi[at]) + (lo[c] - lo[at]));
    rest -= open;
};
const auto axis = [&](float w, int s) {
    beside(d[c-s] ? w : 0.0f, c - s);
    beside(d[c+s] ? w : 0.0f, c + s);
};
axis(cx, 1); axis(cy, row); axis(cz, plane);
const float y = ((v + rest*hi[c]) + b_hi[c]) + b_lo[c];
"""
NATURAL = """
const F f = e != 0 ? e : (F)1;
const F l = code[c] & 1 ? g.least : -(F)INFINITY, u = code[c] & 2 ? g.most : (F)INFINITY;
const F below = f*gap(l), above = f*gap(u), low = below < y ? below : y;
g.r.data[c] = g.unknown.data[c] == 1 ? (above > low ? above : low) : (F)0;
"""
F32, F64 = wp.float32, wp.float64
WAYS = {
    "float64": (PLAIN, F64),
    "two floats": (TWO, F32),
    "differences": (DIFFERENCES, F32),
    "float32": (PLAIN, F32),
}
NUMBERS, CODES, FIELDS = (
    ("unit", "cx", "cy", "cz", "least", "most"),
    ("d", "code"),
    ("hi", "lo", "b_hi", "b_lo"),
)


@wp.func_native(
    PAIRS
    + "const Two s = sum(a, b), p = product(a, b); out.data[at] = wp::vec4f(s.hi, s.lo, p.hi, "
    "p.lo);"
)
def pairs_of(at: int, a: float, b: float, out: wp.array(dtype=wp.vec4f)): ...  # noqa: D103


@wp.kernel(enable_backward=False, module="warp_lcp.benchmarks.two_floats")
def pairs_kernel(a: wp.array(dtype=float), b: wp.array(dtype=float), out: wp.array(dtype=wp.vec4f)):
    """Compute sums and products with their errors."""
    pairs_of(wp.tid(), a[wp.tid()], b[wp.tid()], out)


def check_pairs() -> None:
    """Check sums and products against float64.

    In float64 those of the chosen numbers are exact.
    """
    random, size = np.random.default_rng(1), 1 << 20
    a, b = (
        (random.uniform(-1, 1, size) * 2.0 ** random.integers(-13, 14, size)).astype(np.float32)
        for _ in range(2)
    )
    out = wp.empty(size, dtype=wp.vec4f, device="cpu")
    wp.launch(
        pairs_kernel,
        size,
        [wp.array(a, device="cpu"), wp.array(b, device="cpu"), out],
        device="cpu",
    )
    found = out.numpy().astype(np.float64)
    for at, exact in ((0, a.astype(np.float64) + b), (2, a.astype(np.float64) * b)):
        assert np.array_equal(found[:, at], exact.astype(np.float32)) and np.array_equal(
            found[:, at] + found[:, at + 1], exact
        )


@cache
def evaluation(way: str) -> tuple[wp.Kernel, type]:
    """Return a kernel that evaluates the natural residual, and its argument struct.

    The kernel has one thread per cell.
    """
    how, real = WAYS[way]
    types = (
        dict.fromkeys(CODES, wp.uint8) | dict.fromkeys((*FIELDS, "r"), real) | {"unknown": wp.int8}
    )
    members = (
        dict.fromkeys(("row", "plane"), int)
        | dict.fromkeys(NUMBERS, real)
        | {n: wp.array(dtype=t) for n, t in types.items()}
    )
    Given = make_struct(f"TwoFloats_{real.__name__}", members)
    head = " ".join(
        [
            f"typedef {C[real]} F;",
            *(f"const auto* {name} = g.{name}.data;" for name in (*CODES, *FIELDS)),
        ]
    )
    head += (
        " const int row = g.row, plane = g.plane; const F e = g.unit*(F)d[c], cx = g.cx, cy = "
        "g.cy, cz = g.cz;\n"
    )

    def residual(c: int, g: Given): ...

    residual.__module__ = f"warp_lcp.benchmarks.two_floats.{way.replace(' ', '_')}"
    at_cell = wp.func_native(PAIRS + head + how + NATURAL)(residual)

    def evaluate(g: Given):
        k, j, i = wp.tid()
        at_cell((k + 1) * g.plane + (j + 1) * g.row + i + 1, g)

    return wp.kernel(enable_backward=False, module=residual.__module__)(evaluate), Given


def split(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two float32 fields whose sum is a float64 one, up to 48 bits."""
    hi = values.astype(np.float32)
    return hi, (values - hi).astype(np.float32)


def evaluated(problem: wl.LCP, way: str, x: np.ndarray) -> np.ndarray:
    """Return the natural residual at x by a kernel."""
    layout, stencil, real, (kernel, Given) = (
        problem.layout,
        problem.A.stencil,
        WAYS[way][1],
        evaluation(way),
    )
    pairs = [
        split(v) if real is F32 else (v, v)
        for v in (layout.load(x, F64).numpy(), problem.b.numpy())
    ]
    parts = [wp.array(part, dtype=real, device="cpu") for pair in pairs for part in pair]
    kernel_args = {
        "row": stencil.padding.row,
        "plane": stencil.padding.plane,
        "d": stencil.d,
        "code": problem.bounds.code,
    }
    kernel_args |= dict(
        zip(
            (*FIELDS, *NUMBERS),
            (*parts, stencil.unit, *stencil.coefficients, *problem.bounds.values),
            strict=True,
        )
    )
    kernel_args |= {"unknown": problem.unknown, "r": wp.zeros_like(parts[0])}
    wp.launch(kernel, x.shape, [put(Given(), kernel_args)], device="cpu")
    return (
        kernel_args["r"]
        .numpy()
        .reshape(layout.stored_shape)[1:-1, 1:-1, 1:-1]
        .astype(np.longdouble)
    )


def exact_residual(scene: Splash, x: np.ndarray) -> np.ndarray:
    """Return the natural residual in longdouble."""
    open_ = np.pad(scene.cells, 1, constant_values=wl.SOLID) != wl.SOLID
    d = sum(
        np.roll(open_, step, axis)[1:-1, 1:-1, 1:-1].astype(np.longdouble)
        for axis in range(3)
        for step in (1, -1)
    )
    y = natural(scene.cells, scene.b.astype(np.longdouble), -np.inf, x)
    return np.where(
        scene.cells == wl.FLUID, np.minimum(np.maximum(d, 1) * (x - scene.lower("walls")), y), 0
    )


def table(title: str, columns: list[str], rows: list[list[object]]) -> None:
    """Print a table."""
    lines = [
        columns,
        ["---"] * len(columns),
        *([f"{e:.3g}" if isinstance(e, float) else str(e) for e in row] for row in rows),
    ]
    print("\n".join([f"\n{title}\n", *(f"| {' | '.join(line)} |" for line in lines)]), flush=True)


def compare() -> None:
    """Print residuals at solutions, and the error of each evaluation at the last one."""
    rows, floors = [], []
    for n in SIZES:
        scene = splash(n)
        problem = scene.lcp("walls", device="cpu")
        for rtol in TOLERANCES:
            result = wl.solve(
                problem, wl.ProjectedMultigrid(), stopping=wl.StoppingCriteria(rtol=rtol)
            )
            x, norm = (
                result.x.numpy(),
                lambda r, unit=result.history[0].residual: float(np.linalg.norm(r.ravel()) / unit),
            )
            residuals, exact = (
                [evaluated(problem, way, x) for way in WAYS],
                exact_residual(scene, x.astype(np.longdouble)),
            )
            rows.append(
                [
                    f"{n}^3",
                    f"{rtol:.0e}",
                    result.status.name,
                    result.iterations,
                    *map(norm, residuals),
                    norm(exact),
                ]
            )
        rounded = exact_residual(scene, sum(part.astype(np.longdouble) for part in split(x)))
        floors.append([f"{n}^3", *(norm(r - exact) for r in (*residuals, rounded))])
    table("Relative residual", ["cells", "rtol", "status", "iterations", *WAYS, "longdouble"], rows)
    table(
        "Floor: relative error of the residual at the last x",
        ["cells", *WAYS, "longdouble, x of 48 bits"],
        floors,
    )


def drawn_problem(seed: int) -> wl.LCP:
    """Return a random problem on a grid with holes, air and some bounds."""
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(5, 50, 3))
    share = rng.uniform(0.93, 1)  # few cells are cut off from the air
    cells = np.where(rng.random(shape) < share, wl.FLUID, rng.choice([wl.SOLID, wl.AIR], shape))
    cells[-1], cells[0, 0, 0] = wl.AIR, wl.FLUID
    size = 10.0 ** rng.uniform(-3, 3)
    b = np.where(cells == wl.FLUID, size * (rng.standard_normal(shape) - rng.uniform(0, 1)), 0.0)
    lower = np.where(rng.random(shape) < rng.random(), 0.0, -np.inf)
    return wl.LCP(wl.GridPoisson(cells, device="cpu"), b, lower)


def compare_drawn(count: int) -> None:
    """Print residuals of each evaluation at solutions of random problems."""
    rows = []
    for rtol in (1e-6, 1e-8, 1e-10):
        residuals_of: dict[str, list[float]] = {way: [] for way in WAYS}
        for seed in range(count):
            problem = drawn_problem(seed)
            stopping = wl.StoppingCriteria(rtol=rtol)
            result = wl.solve(problem, wl.ProjectedMultigrid(), stopping=stopping)
            assert result, f"seed {seed}: {result.status}"
            unit = result.history[0].residual
            for way, residuals in residuals_of.items():
                r = evaluated(problem, way, result.x.numpy())
                residuals.append(float(np.linalg.norm(r.ravel()) / unit))
        reached = [sum(r <= rtol for r in residuals) for residuals in residuals_of.values()]
        rows.append(
            [f"{rtol:.0e}", *reached, *(max(residuals) for residuals in residuals_of.values())]
        )
    columns = ["rtol", *(f"{way}: reach it" for way in WAYS), *(f"{way}: most" for way in WAYS)]
    table(f"{count} drawn problems, solved with residuals in float64", columns, rows)


def count(module: str, kind: str, stored: str) -> list[int]:
    """Return the instructions of a cell, by kind and in total.

    A thread has one cell. Each copy of an unrolled loop stores one `stored`.

    A thread has one cell. Each copy of an unrolled loop stores one `stored`.
    """
    user_modules[module].options["block_dim"] = CUDA_BLOCK
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(module, device=None, arch=[ARCH], module_dir=folder, use_ptx=True)
        text = next(Path(folder).glob("*.ptx")).read_text()
    copies = len(re.findall(rf"\bst\.global\.{stored}\b", text))
    found = Counter(re.findall(rf"^\s*(?:@!?%p\d+ )?(\w+)\.[\w.]*\b{kind}\b", text, re.MULTILINE))
    kinds = [
        sum(sum(divmod(found[name], copies)) for name in names.split()) for names in KINDS.values()
    ]
    return [*kinds, sum(kinds) + (RECIPROCAL - 1) * kinds[3]]


def instructions() -> None:
    """Print instruction counts and times of the solver's kernels and the evaluations."""
    made = {
        name: next(m for m in user_modules if m.startswith(f"warp_lcp.projected_multigrid.{name}."))
        for name in BYTES
    }
    passes = [(f"`{name}`", module, "f64", "f32", BYTES[name]) for name, module in made.items()]
    for way, (_, real) in WAYS.items():
        kind = "f64" if real is F64 else "f32"
        passes.append(
            (f"residual alone, {way}", evaluation(way)[0].module.name, kind, kind, BYTES["assess"])
        )
    rows = []
    for what, module, kind, stored, moved in passes:
        counts = count(module, kind, stored)
        times = (counts[-1] / (MULTIPROCESSORS * RATE[kind] * CLOCK), moved / BANDWIDTH)
        rows.append([what, kind, *counts, *(1e3 * CELLS**3 * t for t in times)])
    columns = ["pass", "type", *KINDS, "in all", "arithmetic [ms]", "memory [ms]"]
    table(f"Instructions of a cell, and times at {CELLS}^3 on an RTX 4090", columns, rows)


if __name__ == "__main__":
    check_pairs()
    compare_drawn(DRAWN)
    compare()
    instructions()
