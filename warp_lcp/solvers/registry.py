"""The methods by name: the one table that scenes, the command line, the tests and the documentation read.

A new method is one file and one line here. Each class says in `supports` on which families of operators it works ("dense", "sparse",
"grid") and in `needs` what else it asks of A.
"""

from __future__ import annotations

from typing import Any

from warp_lcp.solvers.direct_enumeration import DirectEnumeration
from warp_lcp.solvers.incremental_pivoting import IncrementalPivoting
from warp_lcp.solvers.lemke import Lemke
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.psor import ProjectedSOR
from warp_lcp.solvers.quadratic_program import QuadraticProgram

METHODS: dict[str, type[Any]] = {
    "direct-enumeration": DirectEnumeration,
    "incremental-pivoting": IncrementalPivoting,
    "lemke": Lemke,
    "minimum-map-newton": MinimumMapNewton,
    "projected-multigrid": ProjectedMultigrid,
    "psor": ProjectedSOR,
    "quadratic-program": QuadraticProgram,
}
