"""Conjugate gradients against NumPy.

The same iterations, counted on the device or by the host, and every reason to stop.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import assemble
from warp_lcp.kernels import launch_graph as program
from warp_lcp.kernels import thread_pool as team
from warp_lcp.kernels.vectors import rows_of
from warp_lcp.krylov import ConjugateGradient
from warp_lcp.krylov.conjugate_gradient import (
    BEST,
    ITERATIONS,
    LIMIT,
    RR,
    RZ,
    RZ_OLD,
    SLOTS,
    TOLERANCE,
    end_kernel,
)
from warp_lcp.operators.grid_poisson import GridPoisson
from warp_lcp.subproblems.active_set_kernels import DIVIDE

SHAPE = (5, 6, 7)


class JacobiPreconditioner:
    """Preconditioner z = r / d, as a program or launch by launch."""

    def __init__(self, A, recorded):
        stencil = A.stencil
        self.r, self.z = (
            wp.zeros(stencil.d.size, dtype=wp.float64, device=A.device) for _ in range(2)
        )
        d = np.maximum(stencil.d.numpy().astype(float) * stencil.unit, 1.0)
        self._divide = DIVIDE.bind(
            rows_of(self.r), r=self.r, d=wp.array(d, dtype=wp.float64, device=A.device), z=self.z
        )
        if recorded:
            self.program = program.CommandBuffer(A.device)
            self._divide.launch(self.program.launch)

    def apply(self):
        self._divide.launch()


@pytest.fixture
def cells():
    return np.random.default_rng(103).choice(3, SHAPE, p=[0.15, 0.75, 0.1])


def numpy_iterations(A, b, d, tolerance, most):
    """Return iterations, norm and x of preconditioned conjugate gradients.

    In textbook form.
    """
    x, r, p, rz = np.zeros_like(b), b.copy(), np.zeros_like(b), np.inf
    iteration = 0
    while iteration < most and np.linalg.norm(r) > tolerance:
        iteration += 1
        z = r / d
        old, rz = rz, r @ z
        p = z + (rz / old) * p
        alpha = rz / (p @ (A @ p))
        x, r = x + alpha * p, r - alpha * (A @ p)
    return iteration, np.linalg.norm(r), x


@pytest.fixture(params=["recorded", "launches", "device loop"])
def krylov(request, cells, device, monkeypatch):
    """Return the solver in three ways to loop.

    A CPU graph stands for the GPU's where there is no GPU.
    """
    if request.param == "device loop":
        monkeypatch.setattr(program, "loops_on_device", lambda _: True)
        monkeypatch.setattr(team.STATE, "team", None)
        monkeypatch.setattr(team, "_entry", lambda: None)
    A = GridPoisson(cells, device=device, dtype=wp.float64)
    preconditioner = JacobiPreconditioner(A, recorded=request.param != "launches")
    krylov = ConjugateGradient(A.stencil.product, preconditioner)
    if request.param == "device loop":
        set_right_side(preconditioner, np.ones(SHAPE) * (cells == wl.FLUID))
        krylov.solve(1e-3, 3)  # the first solve loads the kernels
        assert not krylov._program._loops
    return krylov, preconditioner


def set_right_side(preconditioner, b):
    preconditioner.r.assign(np.pad(b, 1).ravel())


def test_iterations_are_those_of_the_textbook(krylov, cells):
    krylov, preconditioner = krylov
    unknown = (cells == wl.FLUID).ravel()
    A = assemble(cells)[np.ix_(unknown, unknown)]
    rng = np.random.default_rng(107)
    for tolerance, most in ((1e-2, 100), (1e-8, 100), (1e-30, 4), (1e-30, 1), (1e-8, 100)):
        b = rng.standard_normal(SHAPE) * (cells == wl.FLUID)
        set_right_side(preconditioner, b)
        iterations, norm = krylov.solve(tolerance, most)
        expected, expected_norm, x = numpy_iterations(
            A, b.ravel()[unknown], np.maximum(np.diag(A), 1), tolerance, most
        )
        assert iterations == expected
        assert norm == pytest.approx(expected_norm, rel=1e-6)
        found = krylov.x.numpy().reshape([n + 2 for n in SHAPE])[1:-1, 1:-1, 1:-1].ravel()
        np.testing.assert_allclose(found[unknown], x, atol=1e-9)


def test_no_iteration_where_none_is_allowed(krylov, cells):
    krylov, preconditioner = krylov
    set_right_side(preconditioner, 1.0 * (cells == wl.FLUID))
    assert krylov.solve(1e-8, 0) == (0, np.inf)
    assert not krylov.x.numpy().any()


def test_a_right_side_that_is_no_number_stops_at_once(krylov, cells):
    krylov, preconditioner = krylov
    b = 1.0 * (cells == wl.FLUID)
    b[tuple(np.argwhere(b)[0])] = np.nan
    set_right_side(preconditioner, b)
    iterations, norm = krylov.solve(1e-8, 50)
    assert iterations == 1
    assert not np.isfinite(norm)


@pytest.mark.parametrize(
    ("norm", "best", "iterations", "going"),
    [
        (2.0, 3.0, 5, True),
        (1.0, 3.0, 5, False),  # at the tolerance
        (2.0, 3.0, 9, False),  # at the limit
        (2.9e3, 3.0, 5, True),
        (3.1e3, 3.0, 5, False),  # a carried residual that has grown so far is meaningless
        (np.nan, 3.0, 5, False),
        (np.inf, np.inf, 0, False),
        (2.0, np.inf, 0, True),
    ],
)
def test_every_reason_to_stop(norm, best, iterations, going, device):
    scalars = np.zeros(int(SLOTS))
    scalars[[int(slot) for slot in (RR, BEST, ITERATIONS, TOLERANCE, LIMIT)]] = (
        norm**2,
        best,
        iterations,
        1.0,
        10,
    )
    scalars[int(RZ)] = 7.0
    on_device = wp.array(scalars, dtype=wp.float64, device=device)
    flag = wp.zeros(1, dtype=wp.int32, device=device)
    wp.launch(end_kernel, 1, [on_device, flag], device=device)
    assert bool(flag.numpy()[0]) == going
    found = on_device.numpy()
    assert found[int(ITERATIONS)] == iterations + 1
    assert found[int(RZ_OLD)] == 7.0
    if going:
        assert found[int(BEST)] == pytest.approx(min(norm, best))


def test_a_device_loop_is_captured_once(cells, device, monkeypatch):
    monkeypatch.setattr(program, "loops_on_device", lambda _: True)
    monkeypatch.setattr(team.STATE, "team", None)
    monkeypatch.setattr(team, "_entry", lambda: None)
    A = GridPoisson(cells, device=device, dtype=wp.float64)
    preconditioner = JacobiPreconditioner(A, recorded=True)
    krylov = ConjugateGradient(A.stencil.product, preconditioner)
    for _ in range(3):
        set_right_side(preconditioner, 1.0 * (cells == wl.FLUID))
        iterations, norm = krylov.solve(1e-8, 100)
        assert 1 < iterations < 100
        assert norm <= 1e-8
    assert len(krylov._program._loops) == 1
