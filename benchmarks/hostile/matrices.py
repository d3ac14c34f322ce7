"""Kinds 1, 6, 7, 8, 10, 11 and 13 of the hostile benchmark.

These kinds are matrices, contacts and user-defined operators.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import aslinearoperator

import warp_lcp as wl
from warp_lcp.benchmarks.hostile import draw
from warp_lcp.benchmarks.hostile.case import (
    NAMED,
    HostileAnswer,
    HostileBox,
    HostileCase,
    MalformedInput,
    box_case,
)
from warp_lcp.host_problem import Matrix

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

Rng = np.random.Generator


def rows(rng: Rng) -> HostileCase:
    """Draw a problem in which one or a few rows are 1e8 to 1e16 times larger."""
    n = draw.size(rng, 2, 150)
    what, A = draw.definite(rng, n) if rng.random() < 0.6 else draw.positive(rng, n)
    n, definite = A.shape[0], what not in ("definite plus skew", "M-matrix")
    kind, low, high = draw.bounds(rng, n, str(rng.choice(["lower", "box", "mixed"])))
    x, b = draw.plant(rng, A, low, high)
    # Factors of 1 / eps and beyond hide the other rows.
    large = 10 ** (rng.uniform(8, 16) if rng.random() < 0.5 else rng.uniform(15, 18))
    way = str(rng.choice(["inactive", "inactive", "units", "symmetric units", "start"]))
    some = np.flatnonzero((x == low) | (x == high))
    x0 = None
    # y of held rows becomes large and keeps its sign; x stays the solution
    if way == "inactive" and len(some):
        chosen = rng.choice(some, size=min(len(some), int(rng.integers(1, 3))), replace=False)
        b[chosen] += np.where(x[chosen] == low[chosen], large, -large)
        b[chosen[low[chosen] == high[chosen]]] = 1.0
    elif way == "units":  # rows times s_i > 0 have the same solution
        half = min(np.log10(large), 16) / 2
        s = 10 ** rng.uniform(-half, half, n)
        A, b, definite = draw.scaled(A, s, np.ones(n)), s * b, False
    elif way == "symmetric units":
        s = 10 ** rng.uniform(-np.log10(large) / 4, np.log10(large) / 4, n)
        A, b, x, low, high = draw.scaled(A, s, s), s * b, x / s, low / s, high / s
    elif way == "start":
        x0 = np.clip(
            x + rng.standard_normal(n) * 10 ** rng.uniform(-6, 6, n),
            np.maximum(low, -1e12),
            np.minimum(high, 1e12),
        )
        if len(some):
            b[some[0]] += (
                large if x[some[0]] == low[some[0]] and low[some[0]] < high[some[0]] else 0.0
            )
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=high,
        rtol=draw.tolerance(rng),
        solution=x,
        unique=True,
        solvable=True,
        definite=definite,
    )
    return box_case(rng, f"{what}, {kind} bounds, {way} {large:.0e}", box, x0=x0)


def singular(rng: Rng) -> HostileCase:
    """Draw a singular system or LCP: compatible up to rounding, or incompatible.

    An incompatible one is incompatible by a margin.
    """
    n = draw.size(rng, 2, 800)
    kind = str(
        rng.choice(
            [
                "path",
                "cycle",
                "plane",
                "periodic plane",
                "graph",
                "Reynolds",
                "low rank",
                "chain of states",
            ]
        )
    )
    if kind == "Reynolds":
        return _reynolds(rng)
    if kind in ("path", "cycle"):
        A = draw.laplacian(rng, max(n, 3), weighted=rng.random() < 0.5, cycle=kind == "cycle")
    elif kind in ("plane", "periodic plane"):
        side = max(3, int(n**0.5))
        A = draw.plane_laplacian(
            (side, side + int(rng.integers(0, 4))),
            rng,
            periodic=kind != "plane",
            spread=rng.choice([0.0, 1.0]),
        )
    elif kind == "graph":
        # The graph often has several components or empty rows.
        tails, heads = rng.integers(0, n, 2 * n), rng.integers(0, n, 2 * n)
        A = draw.graph_laplacian(
            n,
            tails[tails != heads],
            heads[tails != heads],
            rng.uniform(0.1, 10, (tails != heads).sum()),
        )
    elif kind == "chain of states":  # A = I - P' of a Markov chain: unsymmetric, singular, 1'A = 0
        n = min(n, 200)
        P = rng.random((n, n)) * (rng.random((n, n)) < 0.2) + np.eye(n, k=1) + np.eye(n, k=1 - n)
        A = np.eye(n) - (P / P.sum(axis=1, keepdims=True)).T
    else:
        n = min(n, 200)
        F = rng.standard_normal((n, max(1, n // 2)))
        A = F @ F.T
    if sp.issparse(A) and A.shape[0] <= 300 and rng.random() < 0.3:
        A = A.toarray()
    n, definite = A.shape[0], kind != "chain of states"
    bound = str(rng.choice(["none", "lower", "mixed"], p=[0.45, 0.4, 0.15]))
    _, low, high = draw.bounds(rng, n, bound)
    x, b = draw.plant(rng, A, low, high)
    solvable: bool | None = True
    # 1'y = 1'b: equations need 1'b = 0, and x >= 0 needs 1'b >= 0.
    if kind not in ("low rank", "graph") and rng.random() < 0.4:
        b = b - b.mean() - 10 ** rng.uniform(-3, 1) * np.abs(b).mean() - 1e-3
        solvable = False if bound in ("none", "lower") else None
    solution = x if solvable else None
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=high,
        rtol=draw.tolerance(rng),
        solution=solution,
        solvable=solvable,
        definite=definite,
    )
    return box_case(
        rng, f"{kind}, {bound} bounds, {'planted' if solvable else 'incompatible'}", box, share=0.3
    )


def _reynolds(rng: Rng) -> HostileCase:
    """Draw the periodic journal bearing: -(h^3 p')' + h' >= 0, p >= 0.

    b sums to 0 up to rounding.
    """
    n, e = draw.size(rng, 12, 1500), float(rng.choice([0.5, 0.9, 0.99, 0.999, 0.9999]))
    h = 1 + e * np.cos(2 * np.pi * (np.arange(n) + rng.random()) / n)
    i = np.arange(n)
    A = draw.graph_laplacian(n, i, (i + 1) % n, ((h + np.roll(h, -1)) / 2) ** 3)
    b = np.roll(h, -1) - np.roll(h, 1)
    b -= b.mean() if rng.random() < 0.7 else 0.0
    low = np.full(n, rng.choice([0.0, -np.inf], p=[0.8, 0.2]))
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=np.full(n, np.inf),
        rtol=draw.tolerance(rng),
        solvable=True,
        definite=True,
    )
    return box_case(rng, f"Reynolds, eccentricity {e}", box, share=0.3)


def narrow(rng: Rng) -> HostileCase:
    """Draw a chain, beam or tridiagonal matrix with bounds in windows."""
    n, bandwidth = draw.size(rng, 50, 8000), int(rng.choice([1, 2, 3], p=[0.65, 0.3, 0.05]))
    n = min(n, {1: n, 2: 2000, 3: 100}[bandwidth])  # condition numbers grow with n^2, n^4 and n^6
    if rng.random() < 0.08 and bandwidth < 3:
        n = draw.size(rng, 10_000, 50_000)
    t, foundation = np.arange(1, n + 1) / (n + 1), 10 ** rng.uniform(-8, -4)
    if bandwidth == 1:
        w = 10 ** (rng.uniform(0, 1) * np.sin(rng.uniform(1, 20) * np.r_[t, 1]))
        A = sp.diags_array([-w[1:-1], w[:-1] + w[1:], -w[1:-1]], offsets=[-1, 0, 1], shape=(n, n))
        wind = rng.choice([0.0, 0.5]) * w[1:-1]
        A = A + sp.diags_array([-wind, np.r_[0.0, wind]], offsets=[-1, 0], shape=(n, n))
    else:
        D = sp.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n)).tocsr()
        A = D @ D + rng.choice([0.0, 1.0]) * D if bandwidth == 2 else D @ D @ D
        A = A + foundation * sp.eye_array(n) if n > 2000 else A
    symmetric = bandwidth > 1 or not np.any(wind)
    load = rng.uniform(5, 60) * np.sin(rng.uniform(1, 30) * t + rng.uniform(0, 6)) - rng.uniform(
        -10, 15
    )
    b = load / (n + 1) ** (2 * bandwidth) if n <= 2000 or bandwidth == 1 else load * foundation
    low = np.full(n, -np.inf) if rng.random() < 0.1 else np.zeros(n)
    high = np.full(n, np.inf)
    for _ in range(int(rng.integers(0, 4))):
        high[np.abs(t - rng.random()) < rng.uniform(0.01, 0.3)] = 10 ** rng.uniform(-2.5, 0)
    box = HostileBox(
        A=A.tocsr(),
        b=b,
        lower=low,
        upper=high,
        rtol=float(rng.choice([1e-6, 1e-8])),
        solvable=True,
        definite=symmetric,
    )
    named = ("minimum-map-newton", "interior-point", "primal-dual-active-set", "mprgp", "lemke")
    name = (
        f"bandwidth {bandwidth}{'' if symmetric else ' with wind'}, {np.isfinite(high).sum()} upper"
    )
    return box_case(rng, name, box, named=named, share=0.15)


def sign(rng: Rng) -> HostileCase:
    """Draw a matrix with its sign flipped, as a whole or in a few rows or entries."""
    n = draw.size(rng, 1, 600)
    what, A = draw.definite(rng, n) if rng.random() < 0.8 else draw.positive(rng, n)
    n, way = (
        A.shape[0],
        str(
            rng.choice(
                ["-M", "negative diagonal", "flipped rows", "a wrong entry"],
                p=[0.6, 0.15, 0.15, 0.1],
            )
        ),
    )
    kind, low, high = draw.bounds(rng, n)
    b = rng.choice([-np.ones(n), rng.standard_normal(n), np.ones(n)])
    some = rng.choice(n, size=max(1, n // 20), replace=False)
    if way == "-M":
        A = -A
    elif way == "flipped rows":
        s = np.ones(n)
        s[some] = -1
        A = draw.scaled(A, s, np.ones(n))
    else:
        A = (A if isinstance(A, np.ndarray) else A.toarray()).copy()
        if way == "negative diagonal":
            A[some, some] *= -1
        else:
            A[some[0], rng.integers(0, n)] -= 10 * np.abs(A).max()
        A = sp.csr_array(A) if n > 100 else A
    box = HostileBox(A=A, b=b, lower=low, upper=high, rtol=1e-6)
    return box_case(rng, f"{way} of {what}, {kind} bounds", box, share=0.25)


def friction(rng: Rng) -> HostileCase:
    """Draw contacts with friction.

    They are scenes of the gallery as boxes, random boxes, and pyramids as LCPs.
    """
    from warp_lcp.gallery.contact_scenes import SCENES
    from warp_lcp.rigid.contact_models import BoxedModel, StewartTrinkleModel

    named = (
        "psor",
        "nncg",
        "subspace-minimization",
        "blocked-gauss-seidel",
        "projected-jacobi",
        "staggering",
    )
    rtol = float(rng.choice([1e-6, 1e-4]))
    if rng.random() < 0.25:
        k = draw.size(rng, 1, 40)
        J = rng.standard_normal((3 * k, int(rng.integers(6, max(7, 4 * k)))))
        W, mu = J @ J.T, rng.uniform(0, 1.2)
        normal = np.repeat(3 * np.arange(k), 3)
        normal[::3] = -1
        b = J @ rng.standard_normal(J.shape[1])  # velocities of bodies, so that a solution exists
        low: float | np.ndarray | wl.AffineBounds
        high: float | np.ndarray | wl.AffineBounds
        system_A: Matrix
        name, system_A, system_b = f"random boxed friction, mu {mu:.1f}", W, b
        low, high = wl.AffineBounds.friction(normal, mu)
    else:
        scene = str(rng.choice(sorted(SCENES)))
        count = int(
            rng.integers(
                2,
                {"wall": 5, "leaning-wall": 4, "gear-pyramid": 4, "heavy-on-light": 4}.get(
                    scene, 9
                ),
            )
        )
        count = 2 * (count // 2) + 3 if "snake" in scene else count  # an odd number of links
        ratio = {"ratio": float(10 ** rng.uniform(0, 6))} if scene == "heavy-on-light" else {}
        system = (
            SCENES[scene](count, seed=int(rng.integers(1, 10_000)), **ratio)
            .assemble(10 ** rng.uniform(-3, -1.5))
            .system
        )
        if len(system.q) == 0:
            return friction(rng)
        model = (
            BoxedModel() if rng.random() < 0.75 or len(system.q) > 300 else StewartTrinkleModel(4)
        )
        boxed = model.problem(system)
        assert not isinstance(boxed.A, wl.GridPoisson)
        name, system_A, system_b, low, high = (
            f"{boxed.name}",
            boxed.A,
            np.asarray(boxed.b),
            boxed.lower,
            boxed.upper,
        )
    n = len(system_b)
    if not isinstance(low, wl.AffineBounds) and not isinstance(high, wl.AffineBounds):
        plain = [np.broadcast_to(np.asarray(side, dtype=float), n).copy() for side in (low, high)]
        # The LCP of Anitescu and Potra.
        box = HostileBox(
            A=system_A, b=system_b, lower=plain[0], upper=plain[1], rtol=rtol, solvable=True
        )
        return box_case(
            rng,
            name,
            box,
            named=("lemke", "fischer-newton", "interior-point", "minimum-map-newton"),
            share=0.4,
        )

    def sides(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _side(low, x), _side(high, x)

    box = HostileBox(
        A=system_A,
        b=system_b,
        lower=np.zeros(n),
        upper=np.zeros(n),
        rtol=rtol,
        solvable=True,
        definite=True,
        affine=sides,
    )
    return box_case(rng, name, box, named=named, bounds=(low, high), share=0.3)


def _side(side: float | np.ndarray | wl.AffineBounds, x: np.ndarray) -> np.ndarray:
    """Return constant_i + coefficient_i x_(index_i)."""
    if not isinstance(side, wl.AffineBounds):
        return np.broadcast_to(np.asarray(side, dtype=float), x.shape)
    index = np.broadcast_to(np.asarray(side.index), x.shape).astype(int)
    constant, slope = (
        np.broadcast_to(side.constant, x.shape),
        np.broadcast_to(side.coefficient, x.shape),
    )
    return constant + np.where(index < 0, 0.0, slope * x[np.maximum(index, 0)])


def malformed(rng: Rng) -> HostileCase:
    """Draw malformed sparse matrices, singular blocks, or unusual but valid types.

    In a malformed matrix the arrays contradict each other.
    """
    n = draw.size(rng, 3, 600)
    M = (sp.random_array((n, n), density=min(1.0, 5 / n), rng=rng) + 10 * sp.eye_array(n)).tocsr()
    way = str(
        rng.choice(
            [
                "indices",
                "negative",
                "indptr",
                "lengths",
                "values",
                "type",
                "block",
                "block",
                "block",
                "valid",
                "valid",
            ]
        )
    )
    if way == "block":
        return _singular_block(rng, n)
    if way == "valid":
        low, high = np.zeros(n), np.full(n, np.inf)
        x, b = draw.plant(rng, M, low, high)
        form = str(
            rng.choice(["coo", "csc", "duplicates", "int64", "float32", "dia", "unsorted", "bsr"])
        )
        box = HostileBox(
            A=M,
            b=b,
            lower=low,
            upper=high,
            solution=x,
            unique=True,
            solvable=True,
            storage=6e-8 if form == "float32" else 0.0,
        )
        return box_case(
            rng, f"valid matrix as {form}", box, operator=lambda: _form(M, form), share=0.3
        )
    k = int(rng.integers(0, M.nnz))
    if way == "indices":
        M.indices[k] = int(rng.choice([n, 2 * n, 2_000_000, 2**31 - 1]))
    elif way == "negative":
        M.indices[k] = -int(rng.choice([1, n, 1_000_000]))
    elif way == "indptr":
        M.indptr[int(rng.integers(1, n + 1))] = int(rng.choice([-1, M.nnz + 1000, 2**31 - 1]))
    elif way == "lengths":
        M.data = M.data[: M.nnz // 2].copy()
    elif way == "values":
        M.data[k] = rng.choice([np.nan, np.inf, -np.inf])
    else:
        M = M.astype(complex)
    if rng.random() < 0.3:  # a COO array has no indptr and no lengths to contradict
        M = (
            _as_coo(M)
            if way in ("indices", "negative", "values") and rng.random() < 0.5
            else _as_csc(M)
        )
    method = None if rng.random() < 0.6 else str(rng.choice(NAMED))
    wrapped = rng.random() < 0.5

    def solve() -> HostileAnswer:
        A = wl.SparseOperator(M, device="cpu") if wrapped else M
        result = wl.solve(wl.LCP(A, -np.ones(n)), wl.METHODS[method]() if method else None)
        return HostileAnswer(result.status.name, result.x.numpy())

    return HostileCase(
        f"malformed {M.format} matrix, n={n}: {way}, {method or 'default'}",
        solve,
        MalformedInput(f"{way} of a malformed matrix"),
        None,
    )


def _as_coo(M: sp.csr_array) -> sp.sparray:
    """Return a COO array of the same raw arrays, not validated."""
    count = np.diff(np.clip(M.indptr, 0, len(M.indices)))
    row = np.repeat(np.arange(M.shape[0]), np.maximum(count, 0))[: len(M.data)]
    N = sp.coo_array(M.shape, dtype=M.dtype)
    N.coords, N.data = (row, M.indices[: len(row)]), M.data[: len(row)]
    return N


def _as_csc(M: sp.csr_array) -> sp.sparray:
    """Return a CSC array of the same raw arrays, not validated."""
    N = sp.csc_array(M.shape, dtype=M.dtype)
    N.indptr, N.indices, N.data = M.indptr, M.indices, M.data
    return N


def _form(M: sp.csr_array, form: str) -> sp.sparray:
    """Return M in another valid form."""
    if form in ("coo", "csc", "dia", "bsr"):
        return M.asformat(form)
    N = M.copy()
    if form == "duplicates":  # every entry in two halves
        C = M.tocoo()
        return sp.coo_array(
            (np.r_[C.data, C.data] / 2, (np.r_[C.row, C.row], np.r_[C.col, C.col])), shape=M.shape
        )
    if form == "int64":
        N.indices, N.indptr = N.indices.astype(np.int64), N.indptr.astype(np.int64)
    elif form == "float32":
        N = N.astype(np.float32)
    elif form == "unsorted":
        for i in range(M.shape[0]):
            part = slice(M.indptr[i], M.indptr[i + 1])
            N.indices[part], N.data[part] = M.indices[part][::-1], M.data[part][::-1]
        N.has_sorted_indices = False
    return N


def _singular_block(rng: Rng, n: int) -> HostileCase:
    """Draw a matrix with exactly singular blocks, and a planted solution.

    The blocks have equal rows, empty rows or columns, or zero diagonals.
    """
    symmetric = rng.random() < 0.5
    M = sp.random_array((n, n), density=min(1.0, 3 / n), rng=rng).tocsr()
    if symmetric:
        F = M[:, : max(1, n // 2)]
        M = (F @ F.T).tocsr()
    else:
        M = (M + sp.diags_array(5.0 * (rng.random(n) < 0.8))).tolil()
        some = rng.choice(n, size=max(2, n // 10), replace=False)
        M[some[1]] = M[some[0]]
        M[:, some[-1]] = 0.0
        M = M.tocsr()
    A = M.toarray() if n <= 200 and rng.random() < 0.3 else M
    kind, low, high = draw.bounds(rng, n)
    x, b = draw.plant(rng, A, low, high)
    box = HostileBox(A=A, b=b, lower=low, upper=high, solution=x, solvable=True, definite=symmetric)
    return box_case(
        rng,
        f"{'symmetric' if symmetric else 'unsymmetric'} singular blocks, {kind} bounds",
        box,
        share=0.4,
    )


def odd(rng: Rng) -> HostileCase:
    """Draw further inputs of users.

    They are buffers, functions, empty rows, stacks of masses, cycles and SciPy's lists of pairs.
    """
    way = str(
        rng.choice(["buffer", "operator", "empty row", "stack", "cycle", "pairs", "read-only"])
    )
    n = draw.size(rng, 2, 120)
    what, A = draw.definite(rng, n)
    n, definite = A.shape[0], True
    kind, low, high = draw.bounds(rng, n)
    if way == "stack":  # a stack of masses m_i: J M^-1 J' of neighbors
        mass = 10 ** (rng.uniform(2, 8) * rng.random(n + 1) ** rng.choice([1, 8]))
        if rng.random() < 0.5:  # one heavy body on top of light ones
            mass = np.r_[np.ones(n), 10 ** rng.uniform(2, 8)]
        J = np.eye(n, n + 1) - np.eye(n, n + 1, k=1)
        A, low, high, kind, what = (
            (J / mass) @ J.T,
            np.zeros(n),
            np.full(n, np.inf),
            "lower",
            "stack of masses",
        )
        A = sp.csr_array(A) if rng.random() < 0.4 else A
    elif way == "cycle":
        n = draw.size(rng, 3, 3000)
        delta = 10 ** rng.uniform(-7, -1)
        A = sp.csr_array(
            (np.r_[np.ones(n), np.full(n, delta - 1)], (np.r_[:n, :n], np.r_[:n, np.r_[1:n, 0]])),
            shape=(n, n),
        )
        (kind, low, high), what, definite = draw.bounds(rng, n), f"I - (1 - {delta:.0e}) S", False
    x, b = draw.plant(rng, A, low, high)
    if way == "empty row":
        free = rng.choice(n, size=max(1, n // 10), replace=False)
        keep = np.ones(n)
        keep[free] = 0.0
        A = draw.scaled(A, keep, keep)
        x, b = draw.plant(rng, A, low, high)
        b[free] = 0.0
    unique = way != "empty row"
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=high,
        rtol=draw.tolerance(rng),
        solution=x,
        unique=unique,
        solvable=True,
        definite=definite,
    )
    box = replace(
        box,
        monotone=True,
        largest=1e6 * max(1.0, np.abs(x).max()) if way == "empty row" else np.inf,
    )
    name = f"{way}, {what}, {kind} bounds"
    if way in ("buffer", "operator"):
        return box_case(rng, name, box, operator=lambda: _operator(A, way == "buffer"), share=0.3)
    if way == "read-only":
        return box_case(rng, name, box, operator=lambda: _frozen(A), share=0.3)
    if way == "pairs" and n > 1:
        return HostileCase(f"{name}, n={n}", lambda: _pairs(box), box)
    return box_case(rng, name, box, share=0.35)


def _operator(A: Matrix, buffer: bool) -> wl.LinearOperator | LinearOperator:
    """Return a LinearOperator of a function that may return the same buffer each time."""
    out = np.empty(A.shape[0])

    def multiply(x: np.ndarray) -> np.ndarray:
        out[:] = A @ x
        return out

    return (
        wl.LinearOperator(multiply, (A.shape[0],), symmetric=True)
        if buffer
        else aslinearoperator(A)
    )


def _frozen(A: Matrix) -> Matrix:
    """Return A with read-only arrays; a dense A is in Fortran order."""
    if isinstance(A, np.ndarray):
        A = np.asfortranarray(A)
        A.setflags(write=False)
        return A
    A = A.copy()
    A.data.setflags(write=False)
    return A


def _pairs(box: HostileBox) -> HostileAnswer:
    """Solve with SciPy's list of pairs (l_i, u_i)."""
    pairs = list(zip(box.lower.tolist(), box.upper.tolist(), strict=True))
    found = wl.linear_complementarity(box.A, box.b, bounds=pairs, tol=box.rtol)
    return HostileAnswer(found.result.status.name, np.asarray(found.x).ravel(), found.message)
