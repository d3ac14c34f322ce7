"""Type-checking sample for an installed wheel.

`make wheel-check` runs mypy on this file. Each `ignore` in it must be needed.
"""

from typing import assert_type

import numpy as np

import warp_lcp as wl
from warp_lcp.fluids import LiquidScene
from warp_lcp.granular import GranularSimulator

A = wl.GridPoisson(np.ones((8, 8), dtype=int), device="cpu")
problem = wl.LCP(A, np.zeros(A.shape))
result = wl.solve(problem, wl.MinimumMapNewton())
assert_type(result, wl.SolveResult)
assert_type(result.status, wl.SolveStatus)


def wrong(scene: LiquidScene, simulator: GranularSimulator) -> None:
    """List calls that a type checker must reject."""
    wl.solve(A, wl.MinimumMapNewton())  # type: ignore[arg-type]
    wl.solve(problem, wl.MinimumMapNewton(), tolerance=1e-6)  # type: ignore[arg-type]
    scene.viscosity_of_honey  # type: ignore[attr-defined]  # noqa: B018
    simulator.scene_of_honey  # type: ignore[attr-defined]  # noqa: B018
