"""Rebuild of changed rows: equal to a complete rebuild to the last bit.

Other rows stay untouched.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.multigrid import CycleSettings, Hierarchy
from warp_lcp.multigrid.halo_levels import keep_side_kernel, mark_side_kernel

GRIDS = [
    ((24, 21, 19), (False,) * 3, {}),
    ((40, 37), (False,) * 3, {}),
    ((12, 10, 14), (True, True, True), {}),
    ((14, 9, 12), (False, False, True), {}),
    ((24, 20, 16), (False,) * 3, {"face_y": 100.0}),  # at first only y is coarsened
    ((24, 20, 16), (False,) * 3, {"face_x": 100.0, "face_z": 100.0}),
]
SETTINGS = CycleSettings(coarsest_cpu=8, coarsest_cuda=8, one_launch_cuda=0)


def operator(shape, periodic, numbers, arrays, device, rng):
    cells = rng.choice(3, shape, p=[0.1, 0.85, 0.05])
    faces = dict(numbers)
    if arrays:
        values = rng.uniform(0.1, 1, (*shape[:-1], shape[-1] + 1))
        values[..., -1] = values[..., 0]
        faces["face_x"] = values * numbers.get("face_x", 1.0)
    return cells, wl.GridPoisson(cells, periodic=periodic, device=device, **faces)


def stored(A, free):
    return A.layout.load(free.astype(np.uint8), wp.uint8)


def snapshot(hierarchy):
    fields = [f for lv in hierarchy.levels for f in (lv.stencil.d, *(lv.stencil.weights or ()))]
    return [f.numpy().copy() for f in (*fields, hierarchy._dense.inverse)]


def sets(cells, rng):
    """Yield free sets that differ in one cell, some, a block, none and all."""
    free = np.ones(cells.shape, dtype=bool)
    yield free.copy()
    for _ in range(4):
        free[tuple(rng.integers(0, n) for n in free.shape)] ^= True
        yield free.copy()
    yield free.copy()
    free[tuple(slice(n // 3, n // 2) for n in free.shape)] ^= True
    yield free.copy()
    free ^= rng.random(free.shape) < 0.02
    yield free.copy()
    yield np.zeros(cells.shape, dtype=bool)
    yield rng.random(free.shape) < 0.6


@pytest.mark.parametrize("arrays", [False, True])
@pytest.mark.parametrize(("shape", "periodic", "numbers"), GRIDS)
def test_changed_rows_give_what_a_complete_rebuild_gives(shape, periodic, numbers, arrays, device):
    """Rebuild of changed rows against a complete rebuild.

    A dependent row that is left out keeps a face, or an excess, of the last free set.
    """
    rng = np.random.default_rng(811)
    cells, A = operator(shape, periodic, numbers, arrays, device, rng)
    partly, whole = (
        Hierarchy(A.stencil, wp.float32, bounded=False, settings=SETTINGS) for _ in range(2)
    )
    assert len(whole.levels) > 2
    for free in sets(cells, rng):
        partly.mask_diagonal(A.stencil.d, stored(A, free & (cells == wl.FLUID)))
        partly.rebuild_changed()
        whole.mask_diagonal(A.stencil.d, stored(A, free & (cells == wl.FLUID)))
        whole.rebuild()
        for one, other in zip(snapshot(partly), snapshot(whole), strict=True):
            np.testing.assert_array_equal(one, other)


def test_rows_that_nothing_changed_are_not_touched(device):
    rng = np.random.default_rng(821)
    cells, A = operator((32, 32, 32), (False,) * 3, {}, True, device, rng)
    hierarchy = Hierarchy(A.stencil, wp.float32, bounded=False, settings=SETTINGS)
    fluid = cells == wl.FLUID
    hierarchy.mask_diagonal(A.stencil.d, stored(A, fluid))
    hierarchy.rebuild_changed()
    assert not hierarchy.finest.changed.numpy().any()
    spoiled = [lv.stencil.d for lv in hierarchy.levels[1:]] + [hierarchy._dense.inverse]
    for field in spoiled:
        field.fill_(7.0)
    hierarchy.mask_diagonal(A.stencil.d, stored(A, fluid))
    hierarchy.rebuild_changed()
    assert all((field.numpy() == 7).all() for field in spoiled)
    row = tuple(np.argwhere(fluid)[0])
    fluid[row] = False
    hierarchy.mask_diagonal(A.stencil.d, stored(A, fluid))
    assert np.argwhere(hierarchy.finest.changed.numpy()).tolist() == [list(row[:2])]
    hierarchy.rebuild_changed()
    level = hierarchy.levels[1].stencil
    made = (level.d.numpy().reshape(level.padding.shape)[1:-1, 1:-1, 1:-1] != 7).any(axis=2)
    assert 1 <= made.sum() <= 4  # its own aggregates, and those beside the row
    assert (hierarchy._dense.inverse.numpy() != 7).any()


def test_the_first_rebuild_after_new_cells_is_complete(device):
    rng = np.random.default_rng(823)
    cells, A = operator((16, 16, 16), (False,) * 3, {}, False, device, rng)
    partly = Hierarchy(A.stencil, wp.float32, bounded=False, settings=SETTINGS)
    for _ in range(3):
        partly.mask_diagonal(A.stencil.d, stored(A, cells == wl.FLUID))
        partly.rebuild_changed()
        fresh = Hierarchy(A.stencil, wp.float32, bounded=False, settings=SETTINGS)
        fresh.mask_diagonal(A.stencil.d, stored(A, cells == wl.FLUID))
        fresh.rebuild()
        for one, other in zip(snapshot(partly), snapshot(fresh), strict=True):
            np.testing.assert_array_equal(one, other)
        cells = rng.choice(3, cells.shape, p=[0.2, 0.7, 0.1])
        A.update(wp.array(cells, dtype=wp.int8, device=device))
        partly.refresh()


@pytest.mark.parametrize("arrays", [False, True])
@pytest.mark.parametrize("bounds", ["walls", "everywhere"])
def test_a_solve_leaves_the_hierarchy_of_its_last_free_set(bounds, arrays, device):
    """Hierarchy after a solve: that of its last free set.

    The pass that evaluates the residual marks the rows; one that it misses would be stale in the
    hierarchy.
    """
    rng = np.random.default_rng(827)
    cells, A = operator((18, 20, 22), (False,) * 3, {}, arrays, device, rng)
    b = np.where(cells == wl.FLUID, rng.standard_normal(cells.shape), 0.0)
    lower = (
        np.zeros(cells.shape)
        if bounds == "everywhere"
        else np.where(rng.random(cells.shape) < 0.2, 0.0, -np.inf)
    )
    problem, solver = wl.LCP(A, b, lower), wl.ProjectedMultigrid(cycle=SETTINGS)
    work = solver.init(problem)
    for most in (3, 5, 40):
        result = wl.solve(
            problem,
            solver,
            stopping=wl.StoppingCriteria(rtol=1e-6, max_iterations=most),
            workspace=work,
        )
        work.hierarchy.rebuild_changed()
        found = snapshot(work.hierarchy)
        work.hierarchy.rebuild()
        for one, other in zip(found, snapshot(work.hierarchy), strict=True):
            np.testing.assert_array_equal(one, other)
    assert result


def scene(rng):
    """Return cells of a moving box of FLUID and of some more.

    In rows longer than several spans.
    """
    cells = np.zeros((10, 11, 70), dtype=np.int8)
    low = rng.integers(0, 30)
    cells[rng.integers(0, 3) :, rng.integers(0, 4) :, low : low + rng.integers(1, 40)] = wl.FLUID
    cells[rng.integers(0, 10), rng.integers(0, 11), rng.integers(0, 70)] = wl.FLUID
    cells[rng.integers(0, 10), :, rng.integers(0, 70)] = wl.SOLID
    return cells


# float64 corrections have their own weights.
@pytest.mark.parametrize("real", [wp.float32, wp.float64])
@pytest.mark.parametrize("arrays", [False, True])
def test_new_cells_and_weights_rebuild_the_rows_that_they_change(arrays, real, device):
    """Rebuild after new cells and weights.

    Spans shrink, grow and become empty; weights change in place. Fields that are not 0 outside the
    new spans would enter the next cycle.
    """
    rng = np.random.default_rng(829)
    padded = (12, 13, 72)
    faces = (
        {
            f"face_{a}": wp.array(rng.uniform(0.1, 1, padded), dtype=wp.float32, device=device)
            for a in "xyz"
        }
        if arrays
        else {}
    )
    A = wl.GridPoisson(scene(rng), device=device, **faces)
    partly = Hierarchy(A.stencil, real, bounded=False, settings=SETTINGS)
    cells = None
    for step in range(12):
        if arrays and step % 3 == 1:  # one coefficient, of a face along each axis
            for face in faces.values():
                values = face.numpy()
                values[tuple(rng.integers(1, n - 1) for n in padded)] *= 0.5
                face.assign(values)
        if step % 4 != 1 or cells is None:
            cells = scene(rng)
        A.update(wp.array(cells, dtype=wp.int8, device=device))
        partly.refresh()
        partly.mask_diagonal(A.stencil.d, stored(A, cells == wl.FLUID))
        partly.rebuild_changed()
        fresh = Hierarchy(A.stencil, real, bounded=False, settings=SETTINGS)
        fresh.mask_diagonal(A.stencil.d, stored(A, cells == wl.FLUID))
        fresh.rebuild()
        for one, other in zip(snapshot(partly), snapshot(fresh), strict=True):
            np.testing.assert_array_equal(one, other)
        b = np.where(cells == wl.FLUID, rng.standard_normal(cells.shape), 0.0)
        for hierarchy in (partly, fresh):
            wp.copy(hierarchy.finest.b, A.layout.load(b, real))
            hierarchy.cycle.run()
        for one, other in zip(partly.levels, fresh.levels, strict=True):
            np.testing.assert_array_equal(one.x.numpy(), other.x.numpy())


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_weights_that_keep_every_diagonal_change_their_rows(real, device):
    """Weights that keep every diagonal but change their rows.

    Up on two faces and down on two around an edge of the grid: the sums of the four cells stay.
    """
    cells = np.full((2, 8, 70), wl.FLUID)
    faces = {f"face_{a}": wp.full((4, 10, 72), 0.5, dtype=wp.float32, device=device) for a in "xyz"}
    A = wl.GridPoisson(cells, device=device, **faces)
    hierarchies = [Hierarchy(A.stencil, real, bounded=False, settings=SETTINGS) for _ in range(2)]
    for column in (None, 1, 30, 66):
        for axis, moved in (("x", [(4, 1), (5, 1)]), ("y", [(5, 0), (5, 1)])):
            values = faces[f"face_{axis}"].numpy()
            for row, right in moved if column else ():
                values[1, row, column + right] += 0.25 if axis == "x" else -0.25
            faces[f"face_{axis}"].assign(values)
        A.update(wp.array(cells, dtype=wp.int8, device=device))
        for hierarchy, rebuild in zip(
            hierarchies, (Hierarchy.rebuild_changed, Hierarchy.rebuild), strict=True
        ):
            hierarchy.refresh()
            hierarchy.mask_diagonal(A.stencil.d, stored(A, cells == wl.FLUID))
            rebuild(hierarchy)
        for one, other in zip(*map(snapshot, hierarchies), strict=True):
            np.testing.assert_array_equal(one, other)


def test_new_cells_that_are_the_old_ones_change_no_row(device):
    rng = np.random.default_rng(831)
    cells, A = operator((16, 16, 40), (False,) * 3, {}, True, device, rng)
    hierarchy = Hierarchy(A.stencil, wp.float32, bounded=False, settings=SETTINGS)
    hierarchy.mask_diagonal(A.stencil.d, stored(A, cells == wl.FLUID))
    hierarchy.rebuild_changed()
    A.update(wp.array(cells.astype(np.int8), device=device))
    hierarchy.refresh()
    hierarchy.mask_diagonal(A.stencil.d, stored(A, cells == wl.FLUID))
    assert not hierarchy.finest.changed.numpy().any()


@pytest.mark.parametrize("axis", range(3))
def test_rows_beside_changed_ghost_cells_are_marked(axis, device):
    """Rows beside ghost cells of another process: marked where a ghost cell has changed.

    Nowhere else, and nowhere if none has.
    """
    nx, ny, nz = counts = 4, 3, 2
    rng = np.random.default_rng(841)
    d = rng.uniform(1.0, 2.0, (nz + 2, ny + 2, nx + 2))
    field = wp.array(d, dtype=wp.float64, device=device)
    across = [n for a, n in enumerate(counts[::-1]) if a != 2 - axis]
    known = wp.zeros(across, dtype=wp.float64, device=device)
    changed = wp.zeros((nz, ny), dtype=wp.uint8, device=device)
    at, row = counts[axis] + 1, counts[axis] - 1
    wp.launch(keep_side_kernel, across, [field, axis, at, known], device=device)
    mark = [field, axis, at, row, known, changed]
    wp.launch(mark_side_kernel, across, mark, device=device)
    assert not changed.numpy().any()
    cell = [1, 2, 3]  # k, j, i of a stored cell
    cell[2 - axis] = at
    d[tuple(cell)] += 1.0
    field.assign(d)
    wp.launch(mark_side_kernel, across, mark, device=device)
    expected = np.zeros((nz, ny), dtype=bool)
    beside = [n - 1 for n in cell]
    beside[2 - axis] = row
    expected[beside[0], beside[1]] = True
    np.testing.assert_array_equal(changed.numpy() != 0, expected)
