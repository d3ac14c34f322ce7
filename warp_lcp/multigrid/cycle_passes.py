"""Passes of a multigrid cycle, and the legs that are waves of them: each a plane behind the one before, they stream memory once."""

from dataclasses import replace
from pathlib import Path

from warp_lcp.rows import RowPass, Wave

HEADERS = Path(__file__).parent / "headers"
BOUNDS = {"lower": "S", "upper": "S"}

SWEEP = RowPass(
    "cycle.sweep", HEADERS / "sweep.h", "S", stencil=("F", "S"), reads={"x": "S", "b": "S", **BOUNDS}, optional=("upper",),
    writes={"y": "S"}, numbers={"omega": "S", "from_zero": bool, "projected": bool},
)  # fmt: skip
SWEEP_INTO_RING = replace(SWEEP, name="cycle.into_ring", header=HEADERS / "sweep_into_ring.h", ring=("y",))
SWEEP_OUT_OF_RING = replace(SWEEP, name="cycle.out_of_ring", ring=("x",))
RESTRICT = RowPass(
    "cycle.restrict", HEADERS / "restrict.h", "S", stencil=("F", "S"), finer=True, other={"x": "S", "b": "S"}, writes={"coarse": "S"}
)
CORRECT = RowPass(
    "cycle.correct", HEADERS / "correct.h", "S", stencil=("F", "S"), reads=BOUNDS, optional=("upper",), writes={"x": "S"},
    other={"coarse": "S"}, numbers={"scale": "S", "projected": bool},
)  # fmt: skip
COARSE_BOUNDS = RowPass(
    "cycle.bounds", HEADERS / "coarse_bounds.h", "S", stencil=("F", "S"), finer=True, other={"x": "S", **BOUNDS},
    writes={"coarse_lower": "S", "coarse_upper": "S"}, optional=("upper", "coarse_upper"), numbers={"scale": "S"},
)  # fmt: skip
DESCEND = Wave("cycle.descend", (SWEEP_INTO_RING, 0), (SWEEP_OUT_OF_RING, 1), (RESTRICT, 2))
ASCEND = Wave("cycle.ascend", (CORRECT, 0), (SWEEP_INTO_RING, 1), (SWEEP_OUT_OF_RING, 2))
