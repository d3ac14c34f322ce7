"""Coefficients whose strong direction varies.

The tests cover detection, iteration budgets, cycles, and the rebuild of the shared finest level.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import slow
from warp_lcp.multigrid import CycleSettings, Hierarchy
from warp_lcp.multigrid.multiple_semicoarsening import MultipleSemicoarsening, make_hierarchy, turns
from warp_lcp.multigrid.stencil_level import StencilLevel

AXES = ("face_x", "face_y", "face_z")


def faces_of(shape, strengths):
    """Return face coefficients.

    `strengths` maps places between 0 and 1 to those along x, y, z.
    """
    out = {}
    for axis in range(len(shape)):
        d = len(shape) - 1 - axis
        places = [
            np.arange(n + 1) / n if k == d else (np.arange(n) + 0.5) / n
            for k, n in enumerate(shape)
        ]
        out[AXES[axis]] = strengths(*reversed(np.meshgrid(*places, indexing="ij")))[axis]
    return out


def along(angle, weak):
    """Return strengths in 2-D: 1 along an angle to x, `weak` across it."""
    return np.cos(angle) ** 2 + weak * np.sin(angle) ** 2, np.sin(angle) ** 2 + weak * np.cos(
        angle
    ) ** 2


def turn(weak):
    """Return strengths that turn from x to y over the domain."""
    return lambda x, y: along(0.5 * np.pi * x, weak)


def circles(weak):
    """Return strengths that are large around the center."""
    return lambda x, y: along(np.arctan2(x - 0.5, 0.5 - y), weak)


def waves(weak):
    """Return strengths whose direction varies smoothly."""
    return lambda x, y: along(3 * np.sin(5 * x + 2 * np.cos(4 * y)) + 2 * y, weak)


def halves(weak):
    """Return strengths along x in one half and along y in the other."""
    return lambda x, y: along(0.5 * np.pi * (x > 0.5), weak)


def patch(weak):
    """Return strengths along x, except in a disk, where they are along y."""
    return lambda x, y: along(0.5 * np.pi * (np.hypot(x - 0.4, y - 0.6) < 0.15), weak)


def needles(weak):
    """Return strengths that turn in space: from x to y, and to z."""

    def strengths(x, y, z):
        a, b = 0.5 * np.pi * x, 0.5 * np.pi * z
        squares = (np.cos(a) * np.sin(b)) ** 2, (np.sin(a) * np.sin(b)) ** 2, np.cos(b) ** 2
        return tuple(weak + (1 - weak) * s for s in squares)

    return strengths


def sheets(weak):
    """Return strengths that are large along two axes that turn."""
    return lambda x, y, z: tuple(1 + weak - s for s in needles(weak)(x, y, z))


def framed(shape):
    """Return FLUID cells with AIR all around."""
    return np.pad(np.ones([n - 2 for n in shape], dtype=int), 1)


def load(shape):
    """Return a smooth right-hand side with both signs."""
    places = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    return np.sin(7 * places[0] + 3 * places[1]) * np.cos(5 * places[-1]) - 0.3


def matrix(cells, faces):
    """Return the matrix by SciPy, from the definition.

    Rows and columns of cells that are no unknowns are 0.
    """
    index, d = np.arange(cells.size).reshape(cells.shape), np.zeros(cells.size)
    off = scipy.sparse.csr_array((cells.size, cells.size))
    for axis in range(cells.ndim):
        ax = cells.ndim - 1 - axis
        i, j = (
            index.take(range(cells.shape[ax] - 1), ax).ravel(),
            index.take(range(1, cells.shape[ax]), ax).ravel(),
        )
        c = faces[AXES[axis]].take(range(1, cells.shape[ax]), ax).ravel()
        np.add.at(d, i, c)
        np.add.at(d, j, c)
        off = off + scipy.sparse.coo_array(
            (np.r_[c, c], (np.r_[i, j], np.r_[j, i])), shape=off.shape
        )
    fluid = scipy.sparse.diags_array((cells.ravel() == wl.FLUID).astype(float))
    return (fluid @ (scipy.sparse.diags_array(d) - off) @ fluid).tocsr()


def solved(shape, strengths, lower=-np.inf, upper=np.inf, solver=None):
    """Solve; return the result and its relative residual by SciPy.

    Relative to that of clip(0, l, u).
    """
    cells, faces, b = framed(shape), faces_of(shape, strengths), load(shape)
    A = wl.GridPoisson(cells, **faces, device="cpu", dtype=wp.float64)
    result = wl.solve(wl.LCP(A, b, lower, upper), solver)
    M, q = matrix(cells, faces), np.where(cells == wl.FLUID, b, 0.0).ravel()
    d = np.where(M.diagonal() > 0, M.diagonal(), 1.0)
    points = (
        result.x.numpy().ravel(),
        np.clip(np.zeros(q.size), lower, upper) * (cells.ravel() == wl.FLUID),
    )
    norms = [
        np.linalg.norm(
            (d * (x - np.clip(x - (M @ x + q) / d, lower, upper)))[cells.ravel() == wl.FLUID]
        )
        for x in points
    ]
    return result, norms[0] / norms[1]


@pytest.mark.parametrize(
    ("n", "strengths"),
    [
        *((64, strengths) for strengths in (turn, circles, waves, halves)),
        slow((256, patch)),
        *(slow((256, strengths)) for strengths in (turn, circles, waves, halves)),
        (64, patch),
    ],
)
def test_the_default_solves_turning_anisotropy(n, strengths):
    """Default method on varying anisotropy of 1:1000.

    Without the additional hierarchies it needs 40 to 190 iterations at 256^2. With bounds it needs
    more, and they grow with the grid.
    """
    free, residual = solved((n, n), strengths(1e-3))
    assert free, free.status
    assert residual <= 1.01e-6
    assert free.iterations <= (30 if strengths is patch else 20 if n == 64 else 14)
    size = float(np.abs(free.x.numpy()).max())
    for bounds in ((0.0, np.inf), (-0.3 * size, 0.2 * size)):
        held, residual = solved((n, n), strengths(1e-3), *bounds)
        assert held, held.status
        assert residual <= 1.01e-6
        assert held.iterations <= 1.5 * free.iterations + 6


@pytest.mark.parametrize("weak", [1e-2, 1e-4])
def test_iterations_do_not_depend_on_the_ratio(weak):
    result, residual = solved((128, 128), circles(weak), lower=0.0)
    assert result, result.status
    assert residual <= 1.01e-6
    assert result.iterations <= 14


@pytest.mark.parametrize("strengths", [needles, sheets])
@pytest.mark.parametrize("lower", [-np.inf, 0.0])
def test_turning_in_space(strengths, lower):
    result, residual = solved((24, 26, 28), strengths(1e-3), lower)
    assert result, result.status
    assert residual <= 1.01e-6
    assert result.iterations <= 9


@pytest.mark.parametrize(
    "solver",
    [
        wl.MinimumMapNewton(),
        wl.MPRGP(),
        wl.ProjectedMultigrid(precision="double"),
        wl.InteriorPoint(),
    ],
)
def test_other_methods_take_the_same_cycles(solver):
    result, residual = solved((96, 96), halves(1e-3), 0.0, solver=solver)
    assert result, result.status
    assert residual <= 1.01e-6
    assert result.linear_iterations <= 90


def lognormal(shape):
    rng = np.random.default_rng(71)
    return {
        name: np.exp(3 * rng.standard_normal(face.shape))
        for name, face in faces_of(shape, turn(1.0)).items()
    }


def checkerboard(shape):
    def strengths(x, y):
        k = np.where((np.floor(5 * x) + np.floor(5 * y)) % 2 == 0, 1.0, 1e4)
        return k, k

    return faces_of(shape, strengths)


def slivers(shape):
    rng = np.random.default_rng(73)
    return {
        name: np.where(rng.random(face.shape) < 0.05, 1e-30, 1.0)
        for name, face in faces_of(shape, turn(1.0)).items()
    }


def surface(shape):
    """Return ghost-fluid coefficients 1 / theta along a slanted line of faces.

    And cut fractions along another line.
    """
    faces = {name: face.copy() for name, face in faces_of(shape, turn(1.0)).items()}
    for j in range(shape[0] - 1):
        faces["face_y"][j + 1, j % shape[1]], faces["face_x"][j, (2 * j) % shape[1]] = 1e4, 1e-4
    return faces


def constant(shape):
    return faces_of(shape, lambda x, y: along(0 * x, 1e-3))


def layers(shape):
    return faces_of(
        shape, lambda x, y: 2 * (np.where(np.floor(y * shape[0]) % 2 == 0, 1.0, 1e-3) + 0 * x,)
    )


@pytest.mark.parametrize("faces", [lognormal, checkerboard, slivers, surface, constant, layers])
def test_isotropic_problems_keep_the_single_hierarchy(faces):
    for shape in ((40, 44), (128, 96)):
        A = wl.GridPoisson(framed(shape), **faces(shape), device="cpu")
        assert turns(A.stencil) == []
        assert type(make_hierarchy(A.stencil, wp.float32, bounded=True)) is Hierarchy
    assert turns(wl.GridPoisson(framed((64, 64)), face_x=1e-3, device="cpu").stencil) == []


def test_directions_of_strong_coupling_are_detected():
    A = wl.GridPoisson(framed((128, 128)), **faces_of((128, 128), halves(1e-3)), device="cpu")
    found = sorted(turns(A.stencil))
    np.testing.assert_allclose([way[:2] for way in found], [[1e-3, 1.0], [1.0, 1e-3]], rtol=1e-5)


def made(A, settings=None):
    """Return the hierarchy of an operator, coarsened for all its cells."""
    hierarchy = make_hierarchy(A.stencil, wp.float64, bounded=True, settings=settings)
    assert isinstance(hierarchy, MultipleSemicoarsening)
    assert len(hierarchy.companions) == 2
    hold(A, hierarchy, A.cells.numpy().ravel() == wl.FLUID)
    return hierarchy


def hold(A, hierarchy, free):
    """Set a free set, as methods do."""
    hierarchy.mask_diagonal(A.stencil.d, wp.array(free.astype(np.uint8), device=A.device))
    hierarchy.rebuild_changed()


def operator(device, periodic=False, shape=(32, 32)):
    """Return two halves that are strong along different axes."""
    cells, faces = np.ones(shape, dtype=int), faces_of(shape, halves(1e-3))
    cells[0] = wl.AIR
    return wl.GridPoisson(
        cells, **faces, device=device, dtype=wp.float64, periodic=(False, periodic, False)
    )


def applied(hierarchy, r):
    """Return the result of a cycle applied to r."""
    hierarchy.finest.b.assign(r)
    hierarchy.cycle.run()
    return hierarchy.finest.x.numpy().copy()


@pytest.mark.parametrize("periodic", [False, True])
def test_cycle_is_symmetric_and_positive(device, periodic):
    A = operator(device, periodic)
    hierarchy, inside = made(A), A.cells.numpy().ravel() == wl.FLUID
    rng = np.random.default_rng(79)
    r, s = (rng.standard_normal(inside.size) * inside for _ in range(2))
    Br, Bs = applied(hierarchy, r), applied(hierarchy, s)
    assert np.dot(s, Br) == pytest.approx(np.dot(r, Bs), rel=1e-10)
    assert np.dot(r, Br) > 0


def test_levels_in_one_launch_leave_the_finest_one_out(device):
    """Fused levels without the finest one.

    Such a launch starts from x = 0, and would discard the results of the other hierarchies.
    """
    A = operator(device)
    r = np.random.default_rng(89).standard_normal(A.layout.size) * (
        A.cells.numpy().ravel() == wl.FLUID
    )
    one, apart = (
        applied(made(A, CycleSettings(one_launch_cpu=n, one_launch_cuda=n)), r) for n in (4096, 0)
    )
    np.testing.assert_allclose(one, apart, atol=1e-11 * np.abs(apart).max())


def test_changed_rows_are_coarsened_in_every_hierarchy(device):
    A = operator(device)
    partly, rng = made(A), np.random.default_rng(83)
    free = A.cells.numpy() == wl.FLUID
    free[1, 5:9] &= rng.random(free[1, 5:9].shape) < 0.5
    hold(A, partly, free.ravel())
    assert not partly.finest.changed.numpy().any()
    whole = made(A)
    hold(A, whole, free.ravel())
    whole.rebuild()
    r = rng.standard_normal(free.size) * free.ravel()
    np.testing.assert_array_equal(applied(partly, r), applied(whole, r))


def test_new_cells_in_place(device):
    """New cells in place.

    A workspace that is used again after `update` gives the results of a new one.
    """
    b, more = load((32, 64)), np.ones((32, 64), dtype=np.int8)
    more[0] = wl.AIR
    # The rows' spans are shorter.
    some = np.where(np.indices(more.shape)[1] < 44, more, wl.AIR).astype(np.int8)
    A = operator(device, shape=more.shape)
    problem, method = wl.LCP(A, b), wl.ProjectedMultigrid()
    A.update(wp.array(some, device=device))
    work = method.init(problem)
    for cells in (some, more, some):
        A.update(wp.array(cells, device=device))
        again, fresh = wl.solve(problem, method, workspace=work), wl.solve(problem, method)
        assert again
        assert again.iterations == fresh.iterations <= 15
        np.testing.assert_array_equal(again.x.numpy(), fresh.x.numpy())


def test_legs_apart_give_the_same_iterates(monkeypatch):
    strengths = turn(1e-3)
    fused, _ = solved((64, 64), strengths, 0.0)
    monkeypatch.setattr(StencilLevel, "fuses", False)
    apart, _ = solved((64, 64), strengths, 0.0)
    np.testing.assert_array_equal(apart.x.numpy(), fused.x.numpy())


def test_bytes_of_the_finest_level_are_counted_once():
    hierarchy = made(operator("cpu"))
    finest = Hierarchy.nbytes.fget(hierarchy) - sum(
        lv_bytes(level) for level in hierarchy.levels[1:]
    )
    coarse = [level for part in (hierarchy, *hierarchy.companions) for level in part.levels[1:]]
    assert hierarchy.nbytes == finest + sum(lv_bytes(level) for level in coarse)


def lv_bytes(level):
    """Return the bytes of a level's fields."""
    return sum(
        {v.ptr: v.capacity for v in (level.x, level.b, level.t, level.lower, level.upper)}.values()
    )
