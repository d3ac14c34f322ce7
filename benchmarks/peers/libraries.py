"""Peers in this process, on the assembled matrix.

They are solvers of A x = -b, and of quadratic programs, x'A x / 2 + b'x over x >= lower.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from warp_lcp.benchmarks.peers.peer import PeerAnswer, PeerProblem

CG_PATIENCE, OSQP_PATIENCE = 20_000, 100_000  # iterations


def pyamg(
    question: PeerProblem, tolerance: float, *, build: str = "smoothed_aggregation_solver"
) -> PeerAnswer:
    """Solve by CG with one of PyAMG's hierarchies, all defaults."""
    import pyamg as library

    A, residuals = sp.csr_matrix(question.matrix), list[float]()
    start_time = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyAMG warns about its own use of SciPy
        hierarchy = getattr(library, build)(A)
        middle = time.perf_counter()
        x = hierarchy.solve(-question.b, tol=tolerance, accel="cg", residuals=residuals)
    return PeerAnswer(x, middle - start_time, time.perf_counter() - middle, len(residuals) - 1)


def scipy_cg(question: PeerProblem, tolerance: float) -> PeerAnswer:
    """Solve by plain conjugate gradients."""
    A, b, count = question.matrix, -question.b, list[int]()
    begun = time.perf_counter()
    x, _ = scipy.sparse.linalg.cg(
        A, b, rtol=tolerance, atol=0.0, callback=lambda _: count.append(1)
    )
    return PeerAnswer(x, 0.0, time.perf_counter() - begun, len(count))


def amgcl(question: PeerProblem, tolerance: float) -> PeerAnswer:
    """Solve by CG with AMGCL's smoothed aggregation.

    One sweep of its ILU(0) smooths; it is the fastest of its smoothers here.
    """
    import pyamgcl

    A, b = sp.csr_matrix(question.matrix), -question.b
    start_time = time.perf_counter()
    preconditioner = pyamgcl.amg(
        A, {"coarsening.type": "smoothed_aggregation", "relax.type": "ilu0"}
    )
    solver = pyamgcl.solver(preconditioner, {"type": "cg", "tol": tolerance, "maxiter": 1000})
    middle = time.perf_counter()
    x = solver(b)
    return PeerAnswer(x, middle - start_time, time.perf_counter() - middle, int(solver.iters))


def warp_cg(question: PeerProblem, tolerance: float, *, device: str) -> PeerAnswer:
    """Solve by Warp's conjugate gradients with a diagonal preconditioner.

    The matrix is a Warp BSR matrix in float64.
    """
    import warp as wp
    import warp.optim.linear
    import warp.sparse

    coo, n = question.matrix.tocoo(), len(question.b)
    rows, columns = (wp.array(i, dtype=wp.int32, device=device) for i in coo.coords)
    A = warp.sparse.bsr_from_triplets(
        n, n, rows, columns, wp.array(coo.data, dtype=wp.float64, device=device)
    )
    b, x = (
        wp.array(-question.b, dtype=wp.float64, device=device),
        wp.zeros(n, dtype=wp.float64, device=device),
    )
    wp.synchronize_device(device)
    begun = time.perf_counter()
    M = warp.optim.linear.preconditioner(A, "diag")
    middle = time.perf_counter()
    iterations, _, _ = warp.optim.linear.cg(A, b, x, tol=tolerance, maxiter=CG_PATIENCE, M=M)
    wp.synchronize_device(device)
    return PeerAnswer(x.numpy(), middle - begun, time.perf_counter() - middle, int(iterations))


def cupy_cg(question: PeerProblem, tolerance: float) -> PeerAnswer:
    """Solve by CuPy's plain conjugate gradients on its current CUDA device."""
    import cupy
    import cupyx.scipy.sparse
    import cupyx.scipy.sparse.linalg

    A, b, count = (
        cupyx.scipy.sparse.csr_matrix(sp.csr_matrix(question.matrix)),
        cupy.asarray(-question.b),
        list[int](),
    )
    cupy.cuda.Device().synchronize()
    begun = time.perf_counter()
    x, _ = cupyx.scipy.sparse.linalg.cg(
        A, b, tol=tolerance, maxiter=CG_PATIENCE, callback=lambda _: count.append(1)
    )
    cupy.cuda.Device().synchronize()
    return PeerAnswer(cupy.asnumpy(x), 0.0, time.perf_counter() - begun, len(count))


def osqp(question: PeerProblem, tolerance: float) -> PeerAnswer:
    """Solve by OSQP: operator splitting with one factorization.

    Its tolerances are absolute, in units of b.
    """
    import osqp as library

    P, A = sp.triu(question.matrix, format="csc"), sp.eye_array(len(question.b), format="csc")
    scale = tolerance * float(np.abs(question.b).max())
    start_time = time.perf_counter()
    solver = library.OSQP()
    solver.setup(
        sp.csc_matrix(P),
        question.b,
        sp.csc_matrix(A),
        question.lower,
        np.full(len(question.b), np.inf),
        verbose=False,
        eps_abs=scale,
        eps_rel=0.0,
        max_iter=OSQP_PATIENCE,
        polishing=False,
    )
    middle = time.perf_counter()
    result = solver.solve(raise_error=False)
    return PeerAnswer(
        np.array(result.x), middle - start_time, time.perf_counter() - middle, int(result.info.iter)
    )


def piqp(question: PeerProblem, tolerance: float) -> PeerAnswer:
    """Solve by PIQP: a proximal interior-point method, sparse factorizations."""
    import piqp as library

    P = sp.csc_matrix(question.matrix)
    start_time = time.perf_counter()
    solver = library.SparseSolver()
    solver.settings.eps_abs = tolerance * float(np.abs(question.b).max())
    solver.settings.eps_rel = 0.0
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = tolerance
    solver.setup(P, question.b, x_l=question.lower)
    middle = time.perf_counter()
    solver.solve()
    return PeerAnswer(
        np.array(solver.result.x),
        middle - start_time,
        time.perf_counter() - middle,
        int(solver.result.info.iter),
    )


def clarabel(question: PeerProblem, tolerance: float) -> PeerAnswer:
    """Solve by Clarabel: an interior-point method on a homogeneous embedding.

    Its factorizations are sparse.
    """
    import clarabel as library

    P = sp.csc_matrix(sp.triu(question.matrix, format="csc"))
    bounded = np.flatnonzero(np.isfinite(question.lower))
    rows = sp.csc_matrix(
        (-np.ones(len(bounded)), (np.arange(len(bounded)), bounded)),
        shape=(len(bounded), len(question.b)),
    )
    settings = library.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    start_time = time.perf_counter()
    solver = library.DefaultSolver(
        P,
        question.b,
        rows,
        -question.lower[bounded],
        [library.NonnegativeConeT(len(bounded))],
        settings,
    )
    middle = time.perf_counter()
    solution = solver.solve()
    return PeerAnswer(
        np.array(solution.x),
        middle - start_time,
        time.perf_counter() - middle,
        int(solution.iterations),
    )
