"""Masses of faces, places of shear stresses and faces of walls.

Compared with counts by hand and by NumPy.
"""

from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_lcp.granular.packing import Packing
from warp_lcp.granular.wall_friction import SandWalls, wall_faces
from warp_lcp.grid.grid_part import GridPart
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.operators.grid_poisson import SOLID

DT, DX = 0.01, 0.1


def packed(picture: list[str], **more: Any) -> Packing:
    """Return the packing of a picture, top row first.

    '#' solid, '.' empty, 'o' dense sand, ':' sand of 0.4, '+' of 1.5.
    """
    rows = picture[::-1]
    grid = StaggeredGrid((len(rows[0]), len(rows), 1), DX, 2)
    density, base = (
        np.zeros(grid.shape, dtype=np.float32),
        np.full(grid.shape, SOLID, dtype=np.int8),
    )
    for j, row in enumerate(rows, start=1):
        for i, mark in enumerate(row, start=1):
            base[1, j, i] = SOLID if mark == "#" else 0
            density[1, j, i] = {"#": 0.0, ".": 0.0, "o": 1.0, ":": 0.4, "+": 1.5}[mark]
    one = wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    packing = Packing(grid, wp.array(base, dtype=wp.int8, device=grid.device), one)
    velocity = [
        wp.full(grid.shape, 2.0 + axis, dtype=wp.float32, device=grid.device) for axis in range(2)
    ]
    packing.update(wp.array(density, dtype=wp.float32, device=grid.device), velocity, DT, **more)
    return packing


def plane(field: wp.array) -> np.ndarray:
    """Return the cells of a 2-D field with the domain's upper faces, lowest row first."""
    return np.asarray(field.numpy()[1, 1:, 1:])


def test_a_face_has_the_mean_of_its_cells_as_mass() -> None:
    packing = packed(["o.", "o:", "##"])
    u, v = plane(packing.mass[0]), plane(packing.mass[1])
    np.testing.assert_allclose(u[1:3], [[0.0, 0.7, 0.0], [0.0, 0.5, 0.0]], atol=1e-6)
    # None on walls.
    np.testing.assert_allclose(v[1:4, :2], [[0.0, 0.0], [1.0, 0.2], [0.0, 0.0]], atol=1e-6)
    for mass, inverse, start, given in zip(
        packing.mass, packing.inverse, packing.start, (2.0, 3.0), strict=True
    ):
        m, light = mass.numpy(), inverse.numpy()
        np.testing.assert_allclose(light[m > 0.0], 1.0 / m[m > 0.0], rtol=1e-6)
        assert not light[m == 0.0].any()
        np.testing.assert_array_equal(
            start.numpy(), np.where(m > 0.0, given, 0.0).astype(np.float32)
        )


def test_a_solid_that_moves_sweeps_the_fraction_before_it() -> None:
    shape = packed(["o:", "##"]).grid.shape
    moving = [wp.full(shape, 0.5, dtype=wp.float32, device="cpu") for _ in range(2)]
    packing = packed(["o:", "##"], solid=moving)
    np.testing.assert_allclose(plane(packing.mass[1])[1, :2], [1.0, 0.4], atol=1e-6)
    assert not plane(packing.inverse[1])[1].any()  # stresses do not move it
    np.testing.assert_array_equal(plane(packing.start[1])[1, :2], [0.5, 0.5])


def test_overfull_cells_keep_their_mass_and_push_nothing_out() -> None:
    packing = packed(["+", "+"])
    assert plane(packing.fraction)[0, 0] == pytest.approx(1.5)
    assert plane(packing.mass[1])[1, 0] == pytest.approx(1.5)
    assert not plane(packing.drive).any()


def test_surface_cells_count_as_full_and_loose_ones_do_not() -> None:
    """Room of surface cells and of loose cells.

    max(0.95 - phi, 0) dx / dt is the room of a cell. A partly filled one beside air would have no
    pressure, and so no friction.
    """
    assert plane(packed(["..", ":o", "oo"]).drive)[1, 0] == 0.0
    assert plane(packed([":::"] * 3).drive)[1, 1] == pytest.approx(0.55 * DX / DT, rel=1e-5)


def test_a_gap_that_its_neighbors_fill_is_no_room() -> None:
    """Gap that its neighbors fill: no room.

    The room is that of a cell and its neighbors, by halves along each axis: 0.95 less the fractions
    of eight neighbors.
    """
    assert plane(packed(["+++", "+:+", "+++"]).drive)[1, 1] == 0.0
    assert plane(packed(["ooo", "o:o", "ooo"]).drive)[1, 1] == pytest.approx(
        (0.55 - 3 * 0.05) * DX / DT, rel=1e-5
    )


@pytest.mark.parametrize(
    ("picture", "expected"),
    [
        # None in the corners of the domain.
        (["oo", "oo"], [[0.0, -0.5, 0.0], [-0.5, 0.25, -0.5], [0.0, -0.5, 0.0]]),
        # A loose cell bears no shear, but leans on walls.
        (["oo", ":o"], [[0.0, -0.5, 0.0], [-0.5, 1 / 3, -0.5], [0.0, -0.5, 0.0]]),
        # The surface itself bears none: the face above is empty.
        (["..", "oo"], [[0.0, -0.5, 0.0], [-1.0, 0.0, -1.0], [0.0, 0.0, 0.0]]),
    ],
)
def test_edges_share_shear_among_dense_cells(
    picture: list[str], expected: list[list[float]]
) -> None:
    packing = packed(picture)
    np.testing.assert_allclose(plane(packing.share[0]), expected, atol=1e-6)


def test_an_edge_of_an_empty_face_bears_no_shear() -> None:
    packing = packed(["...", "...", "o.o"])
    assert not (plane(packing.share[0])[1:] > 0.0).any()


def test_copies_weigh_one_together() -> None:
    """Total weight 1 of the copies of a shear stress.

    Equal copies are then the edge's stress.
    """
    random = np.random.default_rng(77)
    rows = ["".join(random.choice(list("ooo:.#"), size=9)) for _ in range(8)]
    packing = packed(rows)
    share, flags, base = (
        packing.share[0].numpy()[1],
        packing.flags.numpy()[1],
        packing.base.numpy()[1],
    )
    for j in range(1, 10):
        for i in range(1, 11):
            cells = [(j, i), (j, i - 1), (j - 1, i), (j - 1, i - 1)]
            if share[j, i] > 0.0:
                assert share[j, i] * sum(bool(flags[c] & 2) for c in cells) == pytest.approx(1.0)
                assert not any(base[c] == SOLID for c in cells)
            elif share[j, i] < 0.0:  # cells with a solid beside them, across the edge
                touching = [
                    flags[c] & 1
                    and base[c] != SOLID
                    and (
                        (base[c[0], 2 * i - 1 - c[1]] == SOLID)
                        != (base[2 * j - 1 - c[0], c[1]] == SOLID)
                    )
                    for c in cells
                ]
                assert -share[j, i] * sum(map(bool, touching)) == pytest.approx(1.0)
                assert any(base[c] == SOLID for c in cells)


@pytest.mark.parametrize("dimension", [2, 3])
def test_wall_faces_lie_between_open_cells_and_solids(dimension: int) -> None:
    random = np.random.default_rng(78)
    shape = (5 if dimension == 3 else 3, 6, 7)
    index = np.zeros(shape, dtype=np.int32)
    index[1:-1, 1:-1, 1:-1] = random.choice([-1, -1, -1, 1, 2], size=np.subtract(shape, 2))
    cells, sides, walls = wall_faces(index, dimension)
    expected = set()
    for cell in np.argwhere(index < 0):
        for axis in range(dimension):
            for side in range(2):
                beyond = cell.copy()
                beyond[2 - axis] += 2 * side - 1
                if index[tuple(beyond)] >= 0:
                    expected.add(
                        (
                            int(np.ravel_multi_index(tuple(cell), shape)),
                            2 * axis + side,
                            int(index[tuple(beyond)]),
                        )
                    )
    assert set(zip(cells.tolist(), sides.tolist(), walls.tolist(), strict=True)) == expected
    assert len(cells) == len(expected)
    assert (np.diff(cells) >= 0).all()  # so that a cell's faces belong to one thread, in one order


class OwnedCells(GridPart):
    """Process that owns some of the cells."""

    def __init__(self, grid: StaggeredGrid, cells: Window) -> None:
        super().__init__(grid)
        self._cells = cells

    @property
    def owned(self) -> Window:
        return self._cells


@pytest.mark.parametrize("dimension", [2, 3])
def test_cells_of_sand_and_the_densest_are_those_that_numpy_finds_in_every_step(
    dimension: int,
) -> None:
    random = np.random.default_rng(dimension)
    grid = StaggeredGrid((7, 5, 4 if dimension == 3 else 1), DX, dimension)
    base = np.where(random.random(grid.shape) < 0.3, SOLID, 0).astype(np.int8)
    capacity = random.uniform(0.2, 1.0, grid.shape).astype(np.float32)
    arrays = [
        wp.array(host, dtype=kind, device=grid.device)
        for host, kind in ((base, wp.int8), (capacity, wp.float32))
    ]
    counted = Window((1, 2, 2), (grid.shape[0] - 1, 5, 6), grid.device)
    object.__setattr__(grid, "part", OwnedCells(grid, counted))
    packing = Packing(grid, *arrays)
    index = np.full(grid.shape, -1, dtype=np.int32)
    index[0], index[-1], index[:, 0], index[:, -1], index[..., 0], index[..., -1] = [0] * 6
    walls = SandWalls(grid, index, [0.5])
    density, velocity = grid.field(), grid.faces()
    for step in range(4):
        host = (
            random.uniform(0.0, 1.2, grid.shape) * (random.random(grid.shape) < 0.5) * (step != 2)
        )
        if step == 3:
            density = grid.field()  # another array than the recorded one
        density.assign(host.astype(np.float32))
        packing.update(density, velocity, DT)
        walls.activate(packing.flags)
        flags = packing.flags.numpy()
        assert packing.sand_cells == np.count_nonzero(
            flags[tuple(map(slice, counted.low, counted.high))]
        )
        seen = (base != SOLID) & (capacity > 0.5)
        seen[: 1 if dimension == 2 else 0] = False
        seen[2 if dimension == 2 else grid.shape[0] :] = False  # in 2-D one plane is used
        assert packing.densest == (density.numpy()[seen] / capacity[seen]).max(initial=0.0)
        held, active = np.flatnonzero(flags.ravel()[walls.cells.numpy()]), walls.active.numpy()
        np.testing.assert_array_equal(active[: 1 + len(held)], [len(held), *held])


def test_an_update_of_a_window_is_that_of_all_cells() -> None:
    """Sand that moves through the grid, packed in the cells around it and in all cells.

    Cells that the sand has left lose it, also after fields were set from outside.
    """
    grid = StaggeredGrid((24, 20, 1), DX, 2)
    base, one = grid.field(wp.int8), wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
    solid = np.full(grid.shape, SOLID, dtype=np.int8)
    solid[1:-1, 1:-1, 1:-1] = 0
    solid[1, 4, 5:9] = SOLID
    base.assign(solid)
    near, whole = Packing(grid, base, one), Packing(grid, base, one)
    velocity = [wp.full(grid.shape, 2.0, dtype=wp.float32, device=grid.device) for _ in range(2)]
    rng = np.random.default_rng(19)
    for step, (j, i) in enumerate([(8, 8), (7, 8), (6, 9), (4, 10), (1, 1), (12, 16)]):
        density = np.zeros(grid.shape, dtype=np.float32)
        density[1, j : j + 5, i : i + 6] = rng.uniform(0.0, 1.3, (5, 6))
        density[solid == SOLID] = 0.0
        window = grid.window((i - 1, j - 1, 0), (i + 4, j + 3, 0), grow=3, shift=1)
        if step == 5:
            near.fraction.assign(np.where(solid == SOLID, 0.0, 0.7))
            near.forget_window()
        for packing, cells in ((near, window), (whole, None)):
            packing.update(wp.array(density, dtype=wp.float32), velocity, DT, (), cells)
        names = ("fraction", "kind", "flags", "stiff", "spans")
        fields = [(getattr(near, name), getattr(whole, name)) for name in names]
        fields += [
            *zip(
                [*near.mass, *near.inverse, *near.share],
                [*whole.mass, *whole.inverse, *whole.share],
                strict=True,
            )
        ]
        for a, b in fields:
            np.testing.assert_array_equal(a.numpy(), b.numpy())
        sand = whole.flags.numpy() != 0
        np.testing.assert_array_equal(near.drive.numpy()[sand], whole.drive.numpy()[sand])
        assert near.sand_cells == whole.sand_cells > 0
