"""Passes of the viscous solve, see `fluids.viscosity`."""

from __future__ import annotations

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.material.boundary_kernels import RELEASED
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID
from warp_lcp.rows import RowPass

HEADERS = Path(__file__).parent / "headers"
F32, I8, U8 = wp.float32, wp.int8, wp.uint8
CLOSE = 1e-3  # cells: a face within it of a wall, or behind it, has the wall's velocity
THETA = 0.02  # cells: the shortest link to a wall
ALIKE = 1.001  # viscosities at most as far apart are one
CORE = 1e-3  # diagonals that differ by less of theirs are alike
ALONG = 0.95  # of a cell that the distance changes by from face to face: the wall lies across the axis
KINDS = {"AIR": AIR, "FLUID": FLUID, "SOLID": SOLID, "RELEASED": RELEASED}
SHIFT = "shift_x shift_y shift_z"  # cells from one less than twice a coarse cell to the finer level's first one in it, in parts of grids
LIMITS = {"CLOSE": CLOSE, "THETA": THETA, "ALONG": ALONG, "ALIKE": ALIKE}


def _fields(names: str, dtype: Any = F32) -> dict[str, Any]:
    return dict.fromkeys(names.split(), dtype)


@functools.cache
def viscous_passes(dimension: int, cut: bool = False, ghost: bool = False, moving: bool = False, varies: bool = False) -> SimpleNamespace:
    """Return the passes of a dimension; those that look at walls differ by these.

    Args:
        dimension: 2 or 3.
        cut: whether solids cut cells.
        ghost: whether the free surface lies between cells.
        moving: whether solids have velocities.
        varies: whether viscosities differ.
    """
    deep = dimension == 3

    def made(name: str, box: dict[str, Any], numbers: str, *, apart: str = "", **more: Any) -> RowPass:
        types = {word: F32 if word in ("scale", "dx") else int for word in numbers.split()}
        module = f"fluids.viscosity_{dimension}d{apart}"
        return RowPass(f"{module}.{name}", HEADERS / f"viscous_{name}.h", F32, box=box, numbers=types, **more)

    walls = "_cut" * cut + "_ghost" * ghost + "_moving" * moving
    macros = KINDS | LIMITS | {"CUT": cut, "GHOST": ghost, "MOVING": moving}
    cells: dict[str, Any] = {"kind": I8, "contact": U8}
    stencil, row = _fields("x y z xb xc cell mixed diagonal"), {"span": wp.int32}
    spans: dict[str, Any] = {"whole": row, "optional": ("z", "xc", "right")}
    carried: dict[str, Any] = {"whole": _fields("coarse") | row, "optional": ("diagonal", "x")}
    sums: dict[str, Any] = {"sums": ("residual", "taken", "given_by_walls", "stiff")}
    near: dict[str, Any] = {"apart": walls, "constants": macros}
    return SimpleNamespace(
        distance=made(
            "distance", _fields("out hold nodes") | {"kind": I8, "wall": wp.int16, "index": wp.int32}, "axis planes walls",
            whole={"slip": F32}, optional=("nodes", "kind", "wall", "index"), **near,
        ),
        weights=made(
            "weights", _fields("cell mixed xy xz yz vx vy vz dx dy dz hx hy hz phi mx my mz") | cells, "planes scale",
            optional=("xz", "yz", "vz", "dz", "hz", "phi", "mx", "my", "mz"), apart=walls + "_varies" * varies,
            constants=macros | {"VARIES": varies},
        ),
        diagonal=made(
            "diagonal", _fields("diagonal drag held d h cell xb xc volume") | cells, "axis planes", optional=("xc",), **near
        ),
        force=made(
            "force",
            _fields("r diagonal u ub uc d h db dc cell mixed xb xc volume change own solid_b solid_c")
            | cells | {"wall": wp.int16, "base": I8},
            "axis planes before_x before_y before_z dx", whole=_fields("turn shift"),
            optional=("uc", "dc", "xc", "change", "own", "solid_b", "solid_c", "wall", "turn", "shift"), **sums, **near,
        ),
        links=made(
            "links",
            _fields("d h db dc cell mixed xb xc diagonal") | cells | _fields("wall wall_b wall_c", wp.int16) | {"index": wp.int32},
            "axis planes before_x before_y before_z dx width from_",
            whole=_fields("counts offsets entry_rows blocks body", wp.int32) | _fields("values center", wp.float64),
            optional=("dc", "wall", "wall_b", "wall_c", "index", "xc", "offsets", "entry_rows", "blocks", "values"), **near,
        ),
        cover=made("cover", _fields("total u hold h own") | {"kind": I8, "base": I8}, "axis", optional=("own",), **near),
        add=made("add", _fields("u total more"), ""),
        sum=made("sum", _fields("u kept more"), ""),
        span=made("span", _fields("dx dy dz"), "", whole=row | {"ends": wp.int32}, optional=("dz", "ends"), constants={"ALIKE": CORE}),
        sweep=made(
            "sweep", stencil | _fields("b scratch"), "axis color order only band", constants={"DEPTH": deep}, whole=row,
            optional=("z", "xc"),
        ),
        product=made("apply", stencil | _fields("out right"), "axis", constants={"DEPTH": deep, "RESIDUAL": False}, **spans),
        residual=made(
            "apply", stencil | _fields("out right"), "axis", apart="_residual", constants={"DEPTH": deep, "RESIDUAL": True}, **spans
        ),
        average=made("average", _fields("out"), f"planes faces scale {SHIFT}", whole={"fine": F32}),
        close=made("close", _fields("out"), f"axis planes {SHIFT}", whole={"fine": F32}),
        coarse_diagonal=made("coarse_diagonal", _fields("diagonal there h volume drag cell xb xc"), "axis planes", optional=("xc",)),
        normalize=made("prolong", _fields("norm diagonal x"), f"axis planes {SHIFT}", apart="_norm", constants={"NORM": True}, **carried),
        prolong=made("prolong", _fields("norm diagonal x"), f"axis planes {SHIFT}", constants={"NORM": False}, **carried),
        restrict=made("restrict", _fields("out diagonal"), f"axis planes {SHIFT}", whole=_fields("fine norm") | row),
    )  # fmt: skip
