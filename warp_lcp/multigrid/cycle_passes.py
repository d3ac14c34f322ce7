"""Passes of a multigrid cycle, and the legs that are waves of them."""

from dataclasses import replace
from pathlib import Path

from warp_lcp.rows import RowPass, Wave

HEADERS = Path(__file__).parent / "headers"
BOUNDS = {"lower": "S", "upper": "S"}

SWEEP = RowPass(
    "cycle.sweep", HEADERS / "sweep.h", "S", stencil=("F", "S"), reads={"x": "S", "b": "S", **BOUNDS}, writes={"y": "S"},
    numbers={"omega": "S", "from_zero": bool, "projected": bool},
)  # fmt: skip
SWEEP_INTO_RING = replace(SWEEP, name="cycle.into_ring", ring=("y",))
SWEEP_OUT_OF_RING = replace(SWEEP, name="cycle.out_of_ring", ring=("x",))
CORRECT = RowPass(
    "cycle.correct", HEADERS / "correct.h", "S", stencil=("F", "S"), reads=BOUNDS, writes={"x": "S"}, other={"coarse": "S"},
    numbers={"scale": "S", "projected": bool},
)  # fmt: skip
ASCEND = Wave("cycle.ascend", (CORRECT, 0), (SWEEP_INTO_RING, 1), (SWEEP_OUT_OF_RING, 2))
