"""What methods cost on a grid: steps and seconds to 1e-3 and to 1e-6, beside projected multigrid.

python -m warp_lcp.benchmarks.sweep_prices 64 pgs nncg
"""

from __future__ import annotations

import argparse

import warp_lcp as wl
from warp_lcp.benchmarks.problems import splash
from warp_lcp.solvers.accelerated_projected_gradient import AcceleratedProjectedGradient
from warp_lcp.solvers.nncg import NNCG
from warp_lcp.solvers.projected_jacobi import ProjectedJacobi
from warp_lcp.solvers.psor import advised_omega
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization

METHODS = {
    "pgs": wl.ProjectedSOR(omega=1.0),
    "psor-1.4": wl.ProjectedSOR(),
    "psor-1.9": wl.ProjectedSOR(omega=1.9),
    "psor-1.95": wl.ProjectedSOR(omega=1.95),
    "jacobi": ProjectedJacobi(),
    "nncg": NNCG(),
    "nncg-symmetric": NNCG(direction="symmetric"),
    "gradient": AcceleratedProjectedGradient(),
    "pgs-sm": SubspaceMinimization(),
    "newton": wl.MinimumMapNewton(),
    "active-set": wl.PrimalDualActiveSet(),
    "mprgp": wl.MPRGP(),
    "fischer": wl.FischerNewton(),
    "interior-point": wl.InteriorPoint(),
    "multigrid": wl.ProjectedMultigrid(),
}
GOALS = (1e-3, 1e-6)


def price(problem: wl.LCP, solver: object, most: int) -> list[str]:
    """Return steps, finest-grid iterations and seconds to each goal; "-" where it was not reached."""
    stopping = wl.StoppingCriteria(rtol=GOALS[-1], max_iterations=most, patience=1000)
    work = solver.init(problem)  # type: ignore[attr-defined]
    wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=0.5, max_iterations=3), workspace=work)  # type: ignore[arg-type]
    result = wl.solve(problem, solver, stopping=stopping, workspace=work)  # type: ignore[arg-type]
    reference, cells = result.residual / result.relative_residual, []
    for goal in GOALS:
        reached = next((record for record in result.history if record.residual <= goal * reference), None)
        cells.append("-" if reached is None else f"{reached.iteration} ({reached.linear_iterations}, {reached.seconds:.2f} s)")
    return cells


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("n", type=int, help="cells along a side")
    parser.add_argument("methods", nargs="*", default=list(METHODS), help=", ".join(METHODS))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--most", type=int, default=4000, help="the most steps")
    arguments = parser.parse_args()
    scene = splash(arguments.n)
    print(f"advised omega {advised_omega(scene.problem('walls', arguments.device)):.3f}")
    print("| bounds | method | steps to 1e-3 (products, time) | to 1e-6 |\n|---|---|---|---|")
    for bounds in ("walls", "everywhere"):
        for name in arguments.methods:
            cells = price(scene.problem(bounds, arguments.device), METHODS[name], arguments.most)
            print(f"| {bounds} | {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
