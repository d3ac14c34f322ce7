"""Peers that solve the complementarity problem as a quadratic program: minimize x'A x / 2 + b'x over x >= lower."""

from __future__ import annotations

import time

import numpy as np
import scipy.sparse as sp

from warp_lcp.benchmarks.peers.peer import Answer, Question

PATIENCE = 100_000  # OSQP's iterations


def osqp(question: Question, tolerance: float) -> Answer:
    """Operator splitting with one factorization; tolerances are absolute, in units of b."""
    import osqp as library

    P, A = sp.triu(question.matrix, format="csc"), sp.eye_array(len(question.b), format="csc")
    scale = tolerance * float(np.abs(question.b).max())
    begun = time.perf_counter()
    solver = library.OSQP()
    solver.setup(
        sp.csc_matrix(P), question.b, sp.csc_matrix(A), question.lower, np.full(len(question.b), np.inf),
        verbose=False, eps_abs=scale, eps_rel=0.0, max_iter=PATIENCE, polishing=False,
    )  # fmt: skip
    middle = time.perf_counter()
    result = solver.solve(raise_error=False)
    return Answer(np.array(result.x), middle - begun, time.perf_counter() - middle, int(result.info.iter))


def piqp(question: Question, tolerance: float) -> Answer:
    """Proximal interior point with sparse factorizations."""
    import piqp as library

    P = sp.csc_matrix(question.matrix)
    begun = time.perf_counter()
    solver = library.SparseSolver()
    solver.settings.eps_abs = tolerance * float(np.abs(question.b).max())
    solver.settings.eps_rel = 0.0
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = tolerance
    solver.setup(P, question.b, x_l=question.lower)
    middle = time.perf_counter()
    solver.solve()
    return Answer(np.array(solver.result.x), middle - begun, time.perf_counter() - middle, int(solver.result.info.iter))


def clarabel(question: Question, tolerance: float) -> Answer:
    """Interior point on a homogeneous embedding, with sparse factorizations."""
    import clarabel as library

    P = sp.csc_matrix(sp.triu(question.matrix, format="csc"))
    bounded = np.flatnonzero(np.isfinite(question.lower))
    rows = sp.csc_matrix((-np.ones(len(bounded)), (np.arange(len(bounded)), bounded)), shape=(len(bounded), len(question.b)))
    settings = library.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    begun = time.perf_counter()
    solver = library.DefaultSolver(P, question.b, rows, -question.lower[bounded], [library.NonnegativeConeT(len(bounded))], settings)
    middle = time.perf_counter()
    solution = solver.solve()
    return Answer(np.array(solution.x), middle - begun, time.perf_counter() - middle, int(solution.iterations))
