"""Published iteration counts, and the counts of the methods here.

The problems can be rebuilt exactly. Each method runs with the settings, the start and the stopping
rule of its source, in double precision; see `docs/published-methods.md`.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.book import appendix_c
from warp_lcp.benchmarks.book import problems as book
from warp_lcp.benchmarks.book.outcome import outcome
from warp_lcp.files import Tables
from warp_lcp.gallery import Problem, ball_obstacle, journal_bearing
from warp_lcp.gallery.obstacle import membrane_height
from warp_lcp.host_problem import Matrix
from warp_lcp.problem.method_protocol import Solver

WITHIN = 2  # iterations by which a count may differ
P4PDES, DEALII, PERMON, TAO, BOOK = (
    "p4pdes",
    "deal.II step-41",
    "PERMON",
    "PETSc/TAO",
    "[Book] table C.2",
)
MURTY, YOUNG = "Murty 1988", "theory"
LEVELS = (17, 33, 65, 129, 257)  # nodes along a side
# PETSc's tolerance of linear systems.
NEWTON: Tables = {"monotone_cycles": 0, "eta": 1e-5, "precision": "double"}
REDUCED = wl.MinimumMapNewton(safeguard=False, **NEWTON)
SEMISMOOTH = wl.FischerNewton(safeguard=False, scaled=False, fischer_weight=1.0, **NEWTON)
SOLVED = 1e-8  # PETSc's relative tolerance
AT_BOUND = 1e-8  # distance from the bound below which PETSc's active set ends
KINK = 1e-12  # size of x - l and y below which TAO moves the point
# As TAO's bqpip: 0.95 of the way to a bound, and a start whose products w s have TAO's mean, 2000.
PREDICTOR_CORRECTOR = wl.InteriorPoint(
    precision="double", monotone_cycles=0, backoff=0.95, start=120.0, predictor_eta=1e-8, eta=1e-8
)


@dataclass(frozen=True)
class PublishedCount:
    """Published iteration counts, and the function that counts here.

    Attributes:
        method: name in `wl.METHODS`.
        problem: problem, grids and start.
        printed: the published numbers.
        source: source of the numbers.
        measure: function that counts iterations here, a number for each printed one.
        reason: why a number here differs by more than WITHIN; empty if none does.
        slow: whether the count takes seconds.
    """

    method: str
    problem: str
    printed: tuple[float, ...]
    source: str
    measure: Callable[[], tuple[float, ...]]
    reason: str = ""
    slow: bool = False

    def row(self, here: Sequence[float]) -> str:
        """Return the row of docs/published-methods.md with the counts measured here."""
        printed, found = (
            ", ".join(f"{n:.4g}" for n in numbers) for numbers in (self.printed, here)
        )
        return f"| `{self.method}` | {self.problem} | {printed} | {found} | {self.source} |"


# A norm of x and y, fields of the problem's shape.
ErrorNorm = Callable[[np.ndarray, np.ndarray], float]


def steps_until(
    problem: wl.LCP,
    method: Solver,
    norm: ErrorNorm,
    tolerance: float,
    *,
    relative: bool = True,
    x0: np.ndarray | None = None,
) -> wl.SolveResult:
    """Solve until a norm of (x, y) is at most a tolerance.

    The tolerance is absolute, or relative to the first value.

    Raises:
        RuntimeError: the method ends earlier.
    """
    work, norms = method.init(problem), list[float]()
    unknown, b = (problem.layout.unload(stored).numpy() for stored in (problem.unknown, problem.b))

    def look(record: wl.Record) -> None:
        x = problem.layout.unload(work.x).numpy().astype(np.float64)
        y = problem.A.apply(wp.array(x, dtype=wp.float64, device=problem.device)).numpy() + b
        norms.append(norm(x, np.where(unknown == 1, y, 0.0)))
        if norms[-1] <= tolerance * (norms[0] if relative else 1.0):
            raise StopIteration

    stopping = wl.StoppingCriteria(rtol=0.0, max_iterations=1000, patience=1000)
    result = wl.solve(problem, method, x0=x0, stopping=stopping, workspace=work, callback=look)
    if result.status is not wl.SolveStatus.STOPPED:
        raise RuntimeError(f"{type(method).__name__} ends {result.status.name} at {norms[-1]:.1e}")
    return result


def reduced_norm(lower: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """Return the norm of y off the active set (PETSc's SNESVINEWTONRSLS)."""
    return float(np.linalg.norm(np.where((x <= lower + AT_BOUND) & (y > 0), 0.0, y)))


def fischer_norm(lower: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """Return the norm of the Fischer-Burmeister map (PETSc's SNESVINEWTONSSLS).

    The map is that of x - l and y.
    """
    a = np.where(np.isfinite(lower), x - lower, 0.0)
    return float(np.linalg.norm(a + y - np.hypot(a, y)))


def projected_gradient_norm(lower: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """Return the norm of the projected gradient: y off the bound, min(y, 0) at it."""
    return float(np.linalg.norm(np.where(x > lower, y, np.minimum(y, 0.0))))


@cache
def hemisphere(n: int) -> Problem:
    """Return PETSc's ex9.c: a membrane over a ball.

    Beyond r^2 = 0.9 the obstacle's height is linear in r^2.
    """
    s = np.linspace(-2, 2, n)
    square = s[:, None] ** 2 + s**2
    edge, height = 0.9, (1 - 0.9**2) ** 0.5
    psi = np.where(
        square <= edge, np.sqrt(np.maximum(1 - square, 0)), height - edge / height * (square - edge)
    )
    return replace(
        ball_obstacle(n, device="cpu", dtype=wp.float64), lower=np.pad(psi[1:-1, 1:-1], 1)
    )


def _membrane(
    n: int, method: Solver, norm: Callable[..., float], x0: np.ndarray | None = None
) -> wl.SolveResult:
    problem = hemisphere(n)
    return steps_until(
        problem.lcp(), method, partial(norm, np.asarray(problem.lower)), SOLVED, x0=x0
    )


def cold_membrane(
    method: Solver, norm: Callable[..., float], levels: Sequence[int] = LEVELS
) -> tuple[float, ...]:
    """Return the iterations on each grid from x = max(0, psi)."""
    return tuple(_membrane(n, method, norm).iterations for n in levels)


def sequenced_membrane(method: Solver, norm: Callable[..., float]) -> tuple[float, ...]:
    """Return the iterations on each grid with grid sequencing.

    Each starts from the bilinear interpolant of the coarser solution; the first has 5^2 nodes.
    """
    counts, x, n = dict[int, float](), None, 5
    while n <= LEVELS[-1]:
        result = _membrane(n, method, norm, x)
        counts[n] = result.iterations
        s = np.linspace(-2, 2, n)
        u = membrane_height(np.hypot(s[:, None], s))
        u[1:-1, 1:-1] = result.x.numpy()[1:-1, 1:-1]
        x, n = _refined(u), 2 * n - 1
    return tuple(counts[n] for n in LEVELS)


def _refined(u: np.ndarray) -> np.ndarray:
    """Return the bilinear interpolant on the grid of half the spacing."""
    n = len(u)
    v = np.zeros((2 * n - 1, 2 * n - 1))
    v[::2, ::2] = u
    v[1::2, ::2] = (u[1:] + u[:-1]) / 2
    v[:, 1::2] = (v[:, 2::2] + v[:, :-1:2]) / 2
    return v


def stairs_problem() -> tuple[wl.LCP, np.ndarray]:
    """Return the problem of deal.II's step-41 and its obstacle.

    It has bilinear elements on 128^2 cells of [-1, 1]^2, the load -10, and u >= a stair of four
    steps.
    """
    n = 129
    x = np.linspace(-1, 1, n)
    stair = np.broadcast_to(
        np.select([x < -0.5, x < 0.0, x < 0.5], [-0.2, -0.4, -0.6], -0.8), (n, n)
    )
    cells = np.pad(np.full((n - 2, n - 2), wl.FLUID), 1, constant_values=wl.AIR)
    element = np.full((3, 3), -1 / 3)
    element[1, 1] = 8 / 3
    A = wl.Stencil(cells, element, outside=wl.AIR, device="cpu", dtype=wp.float64)
    load = 10 * (2 / (n - 1)) ** 2
    return wl.LCP(
        A, np.where(cells == wl.FLUID, load, 0.0), np.where(cells == wl.FLUID, stair, 0.0)
    ), stair


ACTIVE_SET = wl.PrimalDualActiveSet(monotone_cycles=0, eta=1e-3, precision="double")


def stairs() -> tuple[float, ...]:
    """Return the linear solves of the active-set method on the stairs.

    The method ends when the set stays the same. An unknown is active where y > c h^2 (u - g), c =
    100. The first solve has no active unknown.
    """
    problem, stair = stairs_problem()
    weight = 100 * (2 / (len(stair) - 1)) ** 2
    sets = [np.zeros(stair.shape, dtype=bool)]

    def change(u: np.ndarray, y: np.ndarray) -> float:
        sets.append(np.pad((y > weight * (u - stair))[1:-1, 1:-1], 1))
        # The start is no iterate.
        return 1.0 if len(sets) == 2 else float(np.count_nonzero(sets[-1] ^ sets[-2]))

    return (steps_until(problem, ACTIVE_SET, change, 0.0, relative=False).iterations,)


def string_problem() -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return A, b, obstacle and tolerance of PERMON's ex1.c.

    The problem is a string above a sine with 100 nodes.
    """
    n = 100
    h, i = 1 / (n - 1), np.arange(1, n - 1)
    A = 2 * np.eye(n - 2) - np.eye(n - 2, k=1) - np.eye(n - 2, k=-1)
    return A, np.full(n - 2, 30 * h**2), np.sin(4 * np.pi * i * h - np.pi / 6) / 2 - 2, 1e-5


def bearing_problem(nx: int, ny: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return A, b, bound and tolerance of PERMON's jbearing2.c.

    The problem is a journal bearing of eccentricity 0.1.
    """
    problem = journal_bearing(nx, ny, device="cpu").dense()
    assert isinstance(problem.A, np.ndarray)
    return problem.A, problem.b, np.asarray(problem.lower), 1e-6


def gradient_steps(A: Matrix, b: np.ndarray, lower: np.ndarray, tolerance: float) -> float:
    """Return MPRGP's steps to a projected gradient of `tolerance` times b.

    Proportioning steps count separately, as in PERMON.
    """
    norm = partial(projected_gradient_norm, lower)
    method = wl.MPRGP(precision="double", monotone_cycles=0)
    return steps_until(
        wl.LCP(A, b, lower), method, norm, tolerance * float(np.linalg.norm(b)), relative=False
    ).linear_iterations


def string() -> tuple[float, ...]:
    """Return MPRGP's steps on the string."""
    return (gradient_steps(*string_problem()),)


def bearings(*sizes: tuple[int, int]) -> tuple[float, ...]:
    """Return MPRGP's steps on journal bearings."""
    return tuple(gradient_steps(*bearing_problem(*size)) for size in sizes)


def put_problem() -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Return A, the payoff and b(V) of PETSc's blackscholes.c.

    The problem is a time step of an American put by Crank and Nicolson's scheme, for V_t = (rate -
    dividend) S V_S + volatility^2 S^2 / 2 V_SS - rate V, t the time to expiry. The term rate V is
    treated implicitly. Values 10 at S = 0 and 0 at S = 100 are known, so that A has 149 unknowns; V
    has the 151 values of the step before.
    """
    strike, rate, dividend, volatility, step = 10.0, 0.04, 0.01, 0.4, 0.1
    S = np.linspace(0, 100, 151)
    inner, spacing = slice(1, -1), S[1]
    drift, diffusion = (
        (dividend - rate) * S[inner] / (4 * spacing),
        -((volatility * S[inner] / spacing) ** 2) / 4,
    )
    left, right = diffusion - drift, diffusion + drift
    A = np.diag(1 / step + rate - 2 * diffusion) + np.diag(left[1:], -1) + np.diag(right[:-1], 1)

    def right_side(V: np.ndarray) -> np.ndarray:
        b = -V[inner] / step + left * V[:-2] - 2 * diffusion * V[inner] + right * V[2:]
        b[0] += left[0] * strike
        return np.asarray(b)

    return A, np.maximum(strike - S, 0.0), right_side


def fischer_gradient(A: np.ndarray, lower: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """Return the gradient norm of the Fischer-Burmeister merit function.

    As in TAO's semismooth methods, it is the norm of J'f, J = diag(p) + diag(q) A. At kinks, p and
    q are those of a point moved along z, which is 1 at kinks and 0 elsewhere.
    """
    a = x - lower
    rho = np.hypot(a, y)
    kink = rho <= KINK
    z = np.where(kink, 1.0, 0.0)
    u, v = (np.where(kink, moved, value) for moved, value in ((z, a), (A @ z, y)))
    length, f = np.hypot(u, v), a + y - rho
    p, q = 1 - u / length, 1 - v / length
    return float(np.linalg.norm(p * f + A.T @ (q * f)))


def put() -> tuple[float, ...]:
    """Return the Newton steps of the put's nine time steps.

    Each starts from the values of the step before.
    """
    A, payoff, right_side = put_problem()
    lower, V, counts = payoff[1:-1], payoff, list[float]()
    method = wl.FischerNewton(safeguard=False, scaled=False, fischer_weight=1.0, precision="double")
    for _ in range(9):
        problem = wl.LCP(wl.DenseOperator(A, device="cpu"), right_side(V), lower)
        result = steps_until(problem, method, partial(fischer_gradient, A, lower), 1e-5, x0=V[1:-1])
        counts.append(result.iterations)
        V = np.r_[payoff[0], result.x.numpy(), payoff[-1]]
    return tuple(counts)


def gap_norm(x: np.ndarray, y: np.ndarray) -> float:
    """Return the optimality measure of TAO's bqpip, for x >= 0.

    It is the root of the complementarity gap plus the dual infeasibility.
    """
    return float(
        np.sqrt(np.maximum(x, 0.0) @ np.maximum(y, 0.0) + np.abs(np.minimum(y, 0.0)).sum())
    )


def interior_bearing() -> tuple[float, ...]:
    """Return the interior-point steps on the bearing of eccentricity 0.9."""
    problem = journal_bearing(10, 16, 0.9, device="cpu").dense()
    return (
        steps_until(
            wl.LCP(problem.A, problem.b, 0.0), PREDICTOR_CORRECTOR, gap_norm, 1e-4, relative=False
        ).iterations,
    )


def murty_problem(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return A and b of Murty's problem.

    A has 1 on the diagonal and 2 below; b_i = -(2^(n+1) - 2^(n-i)), i = 0, ... n - 1.
    """
    return np.eye(n) + 2 * np.tril(np.ones((n, n)), -1), 2.0 ** (n - np.arange(n)) - 2.0 ** (n + 1)


def pivots(*sizes: int) -> tuple[float, ...]:
    """Return Lemke's pivots on Murty's problems."""
    stopping = wl.StoppingCriteria(rtol=1e-12, max_iterations=2000)
    solved = [wl.solve(wl.LCP(*murty_problem(n)), wl.Lemke(), stopping=stopping) for n in sizes]
    return tuple(result.linear_iterations for result in solved if result)


def slowest_mode(n: int, *, by_rows: bool) -> tuple[np.ndarray, float]:
    """Return the error that sweeps reduce least, shape (n, n), and its factor.

    The operator is the 5-point one on n^2 nodes. The factor of Jacobi is cos(pi h) with h = 1 / (n
    + 1); that of Gauss-Seidel, row by row, is its square (Young 1971).
    """
    k, factor = np.arange(1, n + 1), float(np.cos(np.pi / (n + 1)))
    wave = np.sin(np.pi * k / (n + 1)) * (factor**k if by_rows else 1.0)
    return np.outer(wave, wave), factor**2 if by_rows else factor


def sweeps(n: int, method: Solver, *, by_rows: bool) -> float:
    """Return the sweeps that divide the slowest error by 1e6.

    No bound is active: A x = A 1, x >= 0, from 1 plus that error.
    """
    line = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    A = np.kron(line, np.eye(n)) + np.kron(np.eye(n), line)
    error = slowest_mode(n, by_rows=by_rows)[0].ravel()

    def largest(x: np.ndarray, y: np.ndarray) -> float:
        return float(np.abs(x - 1).max())

    return steps_until(
        wl.LCP(A, -A.sum(axis=1), 0.0), method, largest, 1e-6, x0=1 + error / 2
    ).iterations


def theory(n: int, *, by_rows: bool) -> float:
    """Return the sweeps predicted by the factor of the slowest error."""
    return float(np.ceil(np.log(1e-6) / np.log(slowest_mode(n, by_rows=by_rows)[1])))


def recipe(kind: str, method: str, problems: int) -> tuple[float, ...]:
    """Return the mean iterations by the book's tests on its random problems."""
    make = book.kinds(book.ProblemScale(problems, 10, 30, 100, (16,), (2,), 40))[kind]
    return _mean(method, [make(k) for k in range(problems)])


def contact_problem(k: int, tangents: int = 3) -> Problem:
    """Return a problem of 30 contacts by the recipe of Num4LCP.

    Its Python code fills three of four tangents.
    """
    rng = np.random.default_rng([book.SEED + 1, k])
    return book.recipe(book.contact_matrix(30, rng, tangents), rng, f"contact {k}")


def contacts(problems: int) -> tuple[float, ...]:
    """Return Fischer-Newton's mean iterations on random contacts, by the book's tests."""
    return _mean("Fischer-Newton", [contact_problem(k) for k in range(problems)])


def _mean(method: str, problems: Sequence[Problem]) -> tuple[float, ...]:
    solver, merit = appendix_c.METHODS[method]
    return (statistics.fmean(outcome(method, problems, solver, merit, "cpu").accepted),)


NEWTON_NAME, FISCHER_NAME, FLUID = "minimum-map-newton", "fischer-newton", "fluid, recipe"
JACOBI = "preconditioned by the diagonal here, which varies; without, NumPy takes 119"
HALF_STEP = (
    "the whole step is projected here; with PERMON's half step and fixed step NumPy takes 181"
)
MURTYS, SIDE = (2, 3, 4, 5, 6, 7, 8), 15
COUNTS: tuple[PublishedCount, ...] = (
    PublishedCount(
        NEWTON_NAME,
        "hemisphere, 17^2 to 257^2",
        (3, 6, 7, 12, 21),
        P4PDES,
        partial(cold_membrane, REDUCED, reduced_norm),
    ),
    PublishedCount(
        NEWTON_NAME,
        "the same, from the coarser grid",
        (3, 4, 2, 2, 3),
        P4PDES,
        partial(sequenced_membrane, REDUCED, reduced_norm),
    ),
    PublishedCount(
        FISCHER_NAME,
        "hemisphere, 17^2 to 257^2",
        (7, 11, 11, 16, 25),
        P4PDES,
        partial(cold_membrane, SEMISMOOTH, fischer_norm),
    ),
    PublishedCount(
        FISCHER_NAME,
        "hemisphere, 17^2 to 257^2, from the coarser grid",
        (5, 8, 6, 6, 7),
        P4PDES,
        partial(sequenced_membrane, SEMISMOOTH, fischer_norm),
    ),
    PublishedCount(
        FISCHER_NAME, "American put, 9 time steps", (5, 5, 4, 4, 4, 4, 4, 4, 4), TAO, put
    ),
    PublishedCount(
        "interior-point", "journal bearing, 10 x 16, e = 0.9", (14,), TAO, interior_bearing
    ),
    PublishedCount(
        "lemke",
        "Murty's problems, 2 to 8 unknowns",
        (4, 8, 16, 32, 64, 128, 256),
        MURTY,
        partial(pivots, *MURTYS),
    ),
    PublishedCount("primal-dual-active-set", "stairs, 129^2", (19,), DEALII, stairs),
    PublishedCount("mprgp", "string, 100, projected expansion", (160,), PERMON, string),
    PublishedCount(
        "mprgp", "string, 100, half step and fixed step", (181,), PERMON, string, HALF_STEP
    ),
    PublishedCount(
        "mprgp",
        "journal bearing, 8 x 12, 10 x 16",
        (23, 34),
        PERMON,
        partial(bearings, (8, 12), (10, 16)),
    ),
    PublishedCount(
        "mprgp", "journal bearing, 30 x 30", (119,), PERMON, partial(bearings, (30, 30)), JACOBI
    ),
    PublishedCount(
        FISCHER_NAME,
        "random fluid, 1000",
        (5.0,),
        BOOK,
        partial(recipe, FLUID, "Fischer-Newton", 20),
    ),
    PublishedCount(
        NEWTON_NAME, "random fluid, 1000", (4.07,), BOOK, partial(recipe, FLUID, "minimum map", 20)
    ),
    PublishedCount(
        "psor",
        "random fluid, 1000, omega = 1.4",
        (25.29,),
        BOOK,
        partial(recipe, FLUID, "PSOR 1.4", 100),
        slow=True,
    ),
    PublishedCount(
        "psor",
        "random fluid, 1000, omega = 1",
        (49.38,),
        BOOK,
        partial(recipe, FLUID, "PGS", 100),
        slow=True,
    ),
    PublishedCount(
        FISCHER_NAME, "random contacts, 180", (14.54,), BOOK, partial(contacts, 100), slow=True
    ),
    PublishedCount(
        "projected-jacobi",
        "5-point, 15^2, no bound met",
        (theory(SIDE, by_rows=False),),
        YOUNG,
        lambda: (sweeps(SIDE, wl.ProjectedJacobi(omega=1.0), by_rows=False),),
    ),
    PublishedCount(
        "psor",
        "5-point, 15^2, no bound met, omega = 1",
        (theory(SIDE, by_rows=True),),
        YOUNG,
        lambda: (sweeps(SIDE, wl.ProjectedSOR(omega=1.0), by_rows=True),),
    ),
)


if __name__ == "__main__":  # prints the table of docs/published-methods.md
    for count in COUNTS:
        sys.stdout.write(f"{count.row(count.measure())}\n")
