"""Draw `docs/algorithms.png`: algorithms and figures of the book.

Each has a panel if it has no picture elsewhere. Every panel shows a run of the library. Run
`python docs/generate/algorithm_panels.py`.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import warp as wp
from matplotlib.figure import Figure
from PIL import Image

import warp_lcp as wl
from warp_lcp.gallery.contact_scenes import contact_scene, incline
from warp_lcp.krylov import GMRES
from warp_lcp.rigid.contact_models import (
    BoxedModel,
    ContactModel,
    ContactSystem,
    StewartTrinkleModel,
    proximal_sweeps,
)
from warp_lcp.subproblems.energy_monitor import DECREASE, NonmonotoneSearch

OUT = Path(__file__).parents[1] / "algorithms.png"
TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=400, patience=400)
FAST = 300.0  # slip [m/s] that friction hardly deflects


def residuals(problem: wl.LCP, method: Any, workspace: Any = None) -> np.ndarray:
    """Return the norm of the natural residual after each iteration."""
    norms = list[float]()
    wl.solve(
        problem,
        method,
        stopping=TIGHT,
        workspace=workspace,
        callback=lambda progress: norms.append(progress.residual),
    )
    return np.array(norms)


def friction_panel(axes: Any) -> None:
    """Draw friction of a sliding particle in each direction: circle, polygon, square."""
    mu, mass = 0.5, 2.0
    models: dict[str, ContactModel | None] = {
        "circular cone": None,
        "4 directions": StewartTrinkleModel(4),
        "8 directions": StewartTrinkleModel(8),
        "boxes": BoxedModel(),
    }
    for (label, model), marker in zip(models.items(), ".sDx", strict=True):
        ends = []
        for angle in np.linspace(0, 2 * np.pi, 48, endpoint=False) + 0.03:
            slip = FAST * np.array([np.cos(angle), np.sin(angle)])
            motion = np.array([-1.0 / mass, *slip])
            system = ContactSystem(
                "particle", scipy.sparse.csr_array(np.eye(3) / mass), motion, np.array([mu])
            )
            if model is None:
                r = proximal_sweeps(system)[0]
            else:
                result = wl.solve(
                    model.problem(system).dense().lcp(device="cpu"),
                    "psor" if isinstance(model, BoxedModel) else "lemke",
                )
                r = model.impulses(system, result.x.numpy())
            ends.append(r[1:] / r[0])
        x, y = np.array(ends).T
        axes.plot(x, y, marker, ms=4, mfc="none", label=label)
    axes.set_aspect("equal")
    axes.set_title("1.17, 1.18: friction over normal impulse")
    axes.legend(fontsize=6)


def frame_panel(axes: Any) -> None:
    """Draw the contacts of a box on a plane with their normals and tangents."""
    world = incline(1)
    contacts = world.contacts()
    low, high = contacts.point.min(axis=0), contacts.point.max(axis=0)
    length = 0.4 * float((high - low).max())
    # Oblique view: x to the right, z up, y to the back.
    view = np.array([[1.0, 0.4, 0.0], [0.0, 0.3, 1.0]])
    order = np.argsort(np.arctan2(*(contacts.point - 0.5 * (low + high))[:, [1, 0]].T))
    face = contacts.point[np.append(order, order[0])] @ view.T
    axes.plot(face[:, 0], face[:, 1], "0.6")
    for point, frame in zip(contacts.point, contacts.frames, strict=True):
        for way, color in zip(frame, ("C0", "C1", "C2"), strict=True):
            axes.annotate(
                "",
                view @ (point + length * way),
                view @ point,
                arrowprops={"arrowstyle": "->", "color": color},
            )
    axes.set_aspect("equal")
    axes.margins(0.3)
    axes.set_title("1.16: frames of contacts, box on an incline")


def pivots_panel(axes: Any) -> None:
    """Draw the number of pivots over the unknowns of random definite problems."""
    sizes = (8, 16, 32, 64, 128)
    for label, method in (("Lemke", "lemke"), ("incremental pivoting", "incremental-pivoting")):
        counts = [np.mean([pivots(method, n, seed) for seed in range(20)]) for n in sizes]
        axes.loglog(sizes, counts, "o-", ms=3, label=label)
    axes.set_title("algorithm 2: pivots over unknowns")
    axes.legend(fontsize=6)


def pivots(method: str, n: int, seed: int) -> int:
    """Return the pivots of a random positive definite problem."""
    rng = np.random.default_rng([n, seed])
    F = rng.standard_normal((n, n))
    return wl.solve(
        wl.LCP(F @ F.T + 0.1 * np.eye(n), rng.standard_normal(n), 0.0), method
    ).linear_iterations


def sweep_panel(axes: Any) -> None:
    """Draw sweeps of projected Gauss-Seidel on the energy of two unknowns."""
    A, b = np.array([[1.0, 0.9], [0.9, 1.0]]), np.array([-0.6, -0.5])
    x, y = np.meshgrid(np.linspace(-0.4, 1.2, 60), np.linspace(-0.8, 1.2, 60))
    energy = 0.5 * (A[0, 0] * x * x + 2 * A[0, 1] * x * y + A[1, 1] * y * y) + b[0] * x + b[1] * y
    axes.contour(x, y, energy, 14, colors="0.75", linewidths=0.6)
    problem, path = wl.LCP(A, b, 0.0), [np.array([1.0, 1.1])]
    for _ in range(12):
        once = wl.StoppingCriteria(rtol=1e-14, max_iterations=1)
        path.append(
            wl.solve(problem, wl.ProjectedSOR(omega=1.0), x0=path[-1], stopping=once).x.numpy()
        )
    steps = [
        point for start, end in pairwise(path) for point in (start, np.array([end[0], start[1]]))
    ]
    axes.plot(*np.array([*steps, path[-1]]).T, "o-", ms=3)
    axes.fill_between([-0.4, 0], -0.8, 1.2, color="0.9")
    axes.fill_between([0, 1.2], -0.8, 0, color="0.9")
    axes.set_title("2.2: sweeps, projected onto x >= 0")


def contraction_panel(axes: Any) -> None:
    """Draw residuals of Jacobi and Gauss-Seidel, and the contraction factor."""
    problem = wl.LCP(np.array([[1.0, 0.6], [0.6, 1.0]]), np.array([-1.0, -2.0]), -np.inf)
    for label, method in (
        ("Jacobi", wl.ProjectedJacobi(omega=1.0)),
        ("Gauss-Seidel", wl.ProjectedSOR(omega=1.0)),
    ):
        work = method.init(problem)
        norms = residuals(problem, method, work)
        k = np.arange(len(norms))
        (line,) = axes.semilogy(k, norms, "o", ms=3, label=label)
        axes.semilogy(k, norms[0] * work.contraction.factor**k, color=line.get_color(), lw=0.8)
    axes.set_title("algorithms 3, 4: residual, test's factor (line)")
    axes.legend(fontsize=6)


def diagonal_panel(axes: Any) -> None:
    """Draw the energy of one unknown in [0, 1] and the sweep's result.

    There is one energy for each sign of a.
    """
    x = np.linspace(0, 1, 50)
    for a in (2.0, 0.0, -2.0):
        b = -0.8 if a >= 0 else 0.7
        problem = wl.LCP(np.array([[a]]), np.array([b]), 0.0, 1.0)
        once = wl.StoppingCriteria(rtol=1e-14, max_iterations=1)
        end = float(
            wl.solve(
                problem, wl.ProjectedSOR(omega=1.0), x0=np.array([0.2]), stopping=once
            ).x.numpy()[0]
        )
        (line,) = axes.plot(x, 0.5 * a * x * x + b * x, label=f"a = {a:g}")
        axes.plot(end, 0.5 * a * end * end + b * end, "o", color=line.get_color())
    axes.set_title("2.4: energy in [0, 1], a sweep's end")
    axes.legend(fontsize=6)


def blocks_panel(axes: Any) -> None:
    """Draw residuals of blocks and of staggering on a stack of boxes."""
    problem = contact_scene("box-stack", 4)
    lcp = problem.lcp(device="cpu")
    blocks = [np.arange(start, start + 3) for start in range(0, lcp.layout.size, 3)]
    normal = np.arange(0, lcp.layout.size, 3)
    friction = np.setdiff1d(np.arange(lcp.layout.size), normal)
    methods = {
        "rows": wl.ProjectedSOR(omega=1.0),
        "a block a contact": wl.BlockedGaussSeidel(blocks=blocks),
        "staggered": wl.Staggering(blocks=[normal, friction]),
    }
    for label, method in methods.items():
        axes.semilogy(residuals(lcp, method), label=label)
    axes.set_title("2.2.3, 2.5 to 2.8: stack, residual over sweeps")
    axes.legend(fontsize=6)


def search_panel(axes: Any) -> None:
    """Draw a merit along the projected path, Armijo's bound, and the accepted step."""
    A, b = np.array([[2.0, 1.2], [1.2, 1.5]]), np.array([-1.0, 0.6])
    x, d = np.array([0.2, 0.1]), np.array([2.5, -0.2])

    def merit(t: float) -> float:
        point = np.maximum(x + t * d, 0.0)
        return float(0.5 * np.sum((point - np.maximum(point - A @ point - b, 0.0)) ** 2))

    slope = (merit(1e-7) - merit(0.0)) / 1e-7
    search = NonmonotoneSearch(memory=1)
    search.store_merit(merit(0.0))
    tried = list[float]()

    def trial(length: float) -> float:
        tried.append(length)
        return merit(length)

    taken, value = search.search(trial, slope)
    t = np.linspace(0, 1, 200)
    axes.plot(t, [merit(s) for s in t], label="merit on the path")
    axes.plot(t, merit(0.0) + DECREASE * t * slope, "--", label="Armijo's bound")
    axes.plot(tried, [merit(s) for s in tried], "kx", ms=5, label="steps tried")
    axes.plot(taken, value, "o", label="step taken")
    axes.set_title("algorithm 10: projected line search")
    axes.legend(fontsize=6)


def descent_panel(axes: Any) -> None:
    """Draw residuals of gradient descent and of Fischer-Newton."""
    n = 40
    A = scipy.sparse.diags_array(
        [-np.ones(n - 1), 2.1 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1]
    ).tocsr()
    problem = wl.LCP(A, np.random.default_rng(4).standard_normal(n), 0.0)
    for label, method in (
        ("gradient descent", "gradient-descent"),
        ("Fischer-Newton", "fischer-newton"),
    ):
        axes.semilogy(residuals(problem, method), label=label)
    axes.set_title("algorithm 13: residual over steps")
    axes.legend(fontsize=6)


def gmres_panel(axes: Any) -> None:
    """Draw residuals of GMRES with and without restarts; SciPy's as circles."""
    n, wind = 12, 0.6
    one = scipy.sparse.diags_array(
        [-(1 + wind) * np.ones(n - 1), 2 * np.ones(n), -(1 - wind) * np.ones(n - 1)],
        offsets=[-1, 0, 1],
    )
    eye = scipy.sparse.eye_array(n)
    matrix = (scipy.sparse.kron(one, eye) + scipy.sparse.kron(eye, one)).tocsr()
    b = np.random.default_rng(3).standard_normal(n * n)
    operator = wl.SparseOperator(matrix)
    for restart in (8, 144):
        norms = list[float]()
        scipy.sparse.linalg.gmres(
            matrix,
            b,
            rtol=1e-10,
            restart=restart,
            maxiter=400,
            callback=norms.append,
            callback_type="pr_norm",
        )
        axes.semilogy(norms, lw=0.8, label=f"SciPy, restart {restart}")
        counts, ends = [], []
        for tolerance in (1e-2, 1e-4, 1e-6, 1e-8):
            identity = IdentityPreconditioner(n * n)
            krylov = GMRES(operator.product, identity, restart=restart)
            identity.r.assign(b)
            count, norm = krylov.solve(tolerance * float(np.linalg.norm(b)), 400)
            counts.append(count)
            ends.append(norm / np.linalg.norm(b))
        axes.semilogy(counts, ends, "o", ms=4, mfc="none", label=f"here, restart {restart}")
    axes.set_title("2.4.4: GMRES, residual over iterations")
    axes.legend(fontsize=6)


class IdentityPreconditioner:
    """Identity preconditioner, z = r."""

    def __init__(self, n: int) -> None:
        self.r = wp.zeros(n, dtype=wp.float64)
        self.z = wp.zeros(n, dtype=wp.float64)

    def apply(self) -> None:
        """Copy r to z."""
        wp.copy(self.z, self.r)


PANELS = (
    frame_panel,
    friction_panel,
    pivots_panel,
    sweep_panel,
    contraction_panel,
    diagonal_panel,
    blocks_panel,
    search_panel,
    gmres_panel,
    descent_panel,
)


def main() -> None:
    """Draw all panels."""
    figure: Any = Figure(figsize=(15, 6.2), dpi=80, layout="constrained")
    for axes, panel in zip(figure.subplots(2, 5).ravel(), PANELS, strict=True):
        panel(axes)
        axes.title.set_fontsize(8)
        axes.tick_params(labelsize=6)
    figure.savefig(OUT)
    Image.open(OUT).convert("RGB").quantize(64).save(OUT, optimize=True)


if __name__ == "__main__":
    main()
