"""Passes of a hierarchy: of its cycles, with the legs that are waves of them and stream memory once, and those that build its levels.

Coarser levels are the Galerkin product with piecewise-constant 2 x 2 x 2 aggregates. They keep the 7-point stencil on every level and cope
with any mask: the weight between two aggregates is the sum over the faces between them. A cell's excess is its diagonal less its faces to
other unknowns: what AIR, held unknowns and the shift contribute. An aggregate's diagonal is the sum of its cells' excesses plus its outer
faces, a sum of positive numbers: taking inner faces off the diagonals would cancel. Weights along axes that are not aggregated are not too
stiff, so they are multiplied by `stiffen`, the over-correction that the prolongation applies to all; the excess, whose held neighbors are
one cell and not one aggregate away, by `held`.
"""

from dataclasses import replace
from pathlib import Path

import warp as wp

from warp_lcp.rows import RowPass, Wave

HEADERS = Path(__file__).parent / "headers"
UNBOUNDED = 1e30  # stands for an infinite bound of a correction; corrections are of order one
BOUNDS = {"lower": "S", "upper": "S"}

SWEEP = RowPass(
    "cycle.sweep", HEADERS / "sweep.h", "S", stencil=("F", "S"), reads={"x": "S", "b": "S", **BOUNDS}, optional=("lower", "upper"),
    writes={"y": "S"}, numbers={"omega": "S", "from_zero": bool, "projected": bool},
)  # fmt: skip
SWEEP_INTO_RING = replace(SWEEP, name="cycle.into_ring", header=HEADERS / "sweep_into_ring.h", ring=("y",))
SWEEP_OUT_OF_RING = replace(SWEEP, name="cycle.out_of_ring", ring=("x",))
RESTRICT = RowPass(
    "cycle.restrict", HEADERS / "restrict.h", "S", stencil=("F", "S"), finer=True, other={"x": "S", "b": "S"}, writes={"coarse": "S"}
)
CORRECT = RowPass(
    "cycle.correct", HEADERS / "correct.h", "S", stencil=("F", "S"), reads=BOUNDS, optional=("lower", "upper"), writes={"x": "S"},
    other={"coarse": "S"}, numbers={"scale": "S", "projected": bool},
)  # fmt: skip
COARSE_BOUNDS = RowPass(
    "cycle.bounds", HEADERS / "coarse_bounds.h", "S", stencil=("F", "S"), finer=True, other={"x": "S", **BOUNDS},
    writes={"coarse_lower": "S", "coarse_upper": "S"}, optional=("upper", "coarse_upper"), numbers={"scale": "S"},
)  # fmt: skip
DESCEND = Wave("cycle.descend", (SWEEP_INTO_RING, 0), (SWEEP_OUT_OF_RING, 1), (RESTRICT, 2))
ASCEND = Wave("cycle.ascend", (CORRECT, 0), (SWEEP_INTO_RING, 1), (SWEEP_OUT_OF_RING, 2))
# On a box of cells among those of other processes: the first sweep from zero is made in ghost cells, too, where it needs only their
# right-hand side. So what follows waits for no exchange, but for the residual beside others' cells, which is found again.
DESCEND_FROM_GHOSTS = Wave("cycle.descend_from_ghosts", (SWEEP_INTO_RING, 0), (SWEEP_OUT_OF_RING, 2), (RESTRICT, 3))
COARSEN = RowPass(
    "coarsen.aggregates", HEADERS / "coarsen.h", "S", stencil=("F", "S"), finer=True, other={}, whole={"changed": wp.uint8},
    by_row={"coarse_changed": wp.uint8}, writes=dict.fromkeys(("coarse_d", "coarse_wx", "coarse_wy", "coarse_wz"), "S"),
    numbers={"cells": int, "periodic_x": bool, "periodic_y": bool, "periodic_z": bool, "stiffen": "S", "held": "S"},
)  # fmt: skip
COARSEN_COMPACT = RowPass(
    "coarsen.compact", HEADERS / "coarsen_compact.h", "S", stencil=("F", "W"), finer=True, other={}, by_row={"coarse_changed": wp.uint8},
    whole={"changed": wp.uint8, "coarse_weights": "S"}, writes={"coarse_d": "S"}, constants={"MASK": 0},
    numbers={
        "cells": int, "coarse_size": wp.int64, "periodic_x": bool, "periodic_y": bool, "periodic_z": bool, "stiffen": "S", "held": "S"
    },
)  # fmt: skip
ASSEMBLE = RowPass(
    "coarsen.assemble", HEADERS / "assemble.h", wp.float64, stencil=("F", "W"), whole={"matrix": wp.float64},
    numbers={"cells": int, "lines": int, "planes": int, "periodic_x": bool, "periodic_y": bool, "periodic_z": bool},
)  # fmt: skip
ELIMINATE = RowPass(
    "coarsen.eliminate", HEADERS / "eliminate.h", wp.float64, whole=dict.fromkeys(("matrix", "inverse", "own"), wp.float64),
    numbers={"m": int, "least": wp.float64},
)  # fmt: skip
HOLD = RowPass(
    "coarsen.hold", HEADERS / "hold.h", "B", reads={"d": "A", "free": wp.uint8}, writes={"out_d": "B"}, by_row={"changed": wp.uint8}
)
SOLVE = RowPass(
    "coarsen.solve", HEADERS / "coarse_solve.h", wp.float64, whole={"inverse": wp.float64, "b": "S", "x": "S"},
    numbers={"nx": int, "ny": int, "nz": int},
)  # fmt: skip
INVERT = RowPass(
    "coarsen.invert", HEADERS / "invert.h", wp.float64, whole={"changed": wp.uint8, "matrix": wp.float64, "inverse": wp.float64},
    numbers={"m": int, "flags": int},
)  # fmt: skip
CLEAR = RowPass("cycle.clear", HEADERS / "clear.h", "S", writes={"x": "S"})
CHANGES = {"spans": wp.vec2i, "known": wp.vec2i, "changed": wp.uint8}
LOWER = ("lower_x", "lower_y", "lower_z")
RENEW = RowPass(
    "renew.clear", HEADERS / "renew.h", "S", writes={"x": "S", "b": "S", "t": "S", "diagonals": "F", **dict.fromkeys(LOWER, "S")},
    optional=LOWER, by_row=CHANGES,
)  # fmt: skip
SIGN = RowPass(
    "renew.sign", HEADERS / "sign.h", "S", reads=dict.fromkeys(("weight_x", "weight_y", "weight_z"), "S"),
    by_row={"signs": wp.uint64, "changed": wp.uint8},
)  # fmt: skip
