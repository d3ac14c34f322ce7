import itertools

import numpy as np
import pytest
from cut_cell_tools import MOVING, cut_cells, fields_of, grid_of, placed

from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.motion import Rotation, Translation
from warp_lcp.grid.signed_distance import Box, Plane, Sphere


def open_volume(grid, normal, offset, cell):
    """Return the part of a cell, in 2-D of its area, where n.X > offset.

    It is found by sampling lines along x.
    """
    i, j = cell
    y = j + (np.arange(2000) + 0.5) / 2000
    x = np.clip((offset - normal[1] * y) / normal[0], i, i + 1)
    return float((i + 1 - x).mean() if normal[0] > 0.0 else (x - i).mean())


def test_a_moving_plane_sweeps_what_its_velocity_says():
    """Swept volume of a moving plane against its velocity.

    The open volume of a cell grows by the sum of s_f (1 - a_f) u_f over its faces, including cells
    at the domain's faces.
    """
    grid, velocity, dt = grid_of(2, (9, 7), 0.1), np.array([0.3, -0.2]), 1e-3
    direction = np.array([0.8, 0.6])
    plane = Plane(point=[0.33, 0.27], normal=direction)
    cut = CutCells(
        grid, [placed(plane, motion=Translation(velocity=velocity))], wall_separating=True
    )
    time = 0.2
    cut.move(time, dt)
    u, v = (field.numpy()[1] for field in cut.velocity)
    a, b = (field.numpy()[1] for field in cut.open)
    offset = [
        direction @ ((np.array([0.33, 0.27]) + velocity * t) / 0.1 + 1.0)
        for t in (time - 0.5 * dt, time + 0.5 * dt)
    ]
    swept = np.zeros((7, 9))
    for j, i in itertools.product(range(1, 8), range(1, 10)):
        before, after = (open_volume(grid, direction, o, (i, j)) for o in offset)
        swept[j - 1, i - 1] = (after - before) / dt  # cells/s
    flux_x, flux_y = (1.0 - a) * u / 0.1, (1.0 - b) * v / 0.1
    # On the domain's faces the fraction is 0 and the velocity is the solid's part.
    result = flux_x[1:-1, 2:] - flux_x[1:-1, 1:-1] + flux_y[2:, 1:-1] - flux_y[1:-1, 1:-1]
    np.testing.assert_allclose(result, swept, atol=2e-3 * np.abs(swept).max())
    assert np.abs(swept).max() > 1.0
    assert u[3, 1] == pytest.approx(0.3)  # the solid enters through the domain's left face


def test_velocity_is_that_of_the_way_between_two_times():
    """Velocity of the way between two times.

    A quarter turn about a point: a point's way, not its speed, so that the swept volume is exact;
    open faces have none.
    """
    grid = grid_of(2, (10, 10), 0.1)
    box = Box(lower=[0.32, 0.31], upper=[0.68, 0.69])
    cut = CutCells(
        grid,
        [
            placed(Sphere(center=[0.1, 0.1], radius=0.08), name="still"),
            placed(box, motion=Rotation(rate=90.0, center=[0.5, 0.5]), name="turns"),
        ],
        wall_separating=True,
    )
    assert cut.moves
    assert not cut.whole_cells
    cut.place(1.0)
    cut.set_velocity(1.0, 0.5)
    cosine = np.sqrt(0.5)
    faces = 0
    for axis in range(2):
        velocity, wall = cut.velocity[axis].numpy()[1], cut.wall[axis].numpy()[1]
        for j, i in itertools.product(range(1, 11), range(1, 11)):
            x = (np.array([i, j]) - 1.0 + 0.5 * (np.arange(2) != axis)) * 0.1 - 0.5
            way = (
                np.array(
                    [cosine * x[0] - cosine * x[1] - x[0], cosine * x[0] + cosine * x[1] - x[1]]
                )
                / 0.5
            )
            assert velocity[j, i] == pytest.approx(way[axis] if wall[j, i] == 2 else 0.0, abs=1e-5)
            faces += wall[j, i] == 2
    assert faces > 20
    cut.move(1.5, 0.5)  # the same two times, but now at a face the point is the end of the way
    x = np.array([0.6, 0.55]) - 0.5
    way = (
        np.array([x[0] - cosine * x[0] - cosine * x[1], x[1] + cosine * x[0] - cosine * x[1]]) / 0.5
    )
    assert cut.wall[0].numpy()[1, 6, 7] == 2
    assert cut.velocity[0].numpy()[1, 6, 7] == pytest.approx(way[0], abs=1e-5)
    with pytest.raises(ValueError, match="two different times"):
        cut.set_velocity(1.0, 0.0)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("which", [0, 1])
def test_moving_solids_are_as_if_placed_there(dimension, which):
    """Moving solids equal to solids placed there.

    After moving back and forth nothing remains of former positions.
    """
    grid = grid_of(dimension, (12, 9, 7), 0.1)
    geometry, motion = MOVING[dimension][which]
    resting = [
        placed(
            Box(lower=[0.3, 0.0, 0.0][:dimension], upper=[1.3, 0.1, 0.7][:dimension]),
            name="slab of one cell",
        ),
        placed(
            Plane(point=[0.0, 0.21, 0.0][:dimension], normal=[0.2, 1.0, 0.0][:dimension]),
            name="slope",
        ),
    ]
    moving = CutCells(
        grid, [resting[0], placed(geometry, motion=motion), resting[1]], wall_separating=True
    )
    alone = CutCells(grid, resting, wall_separating=True)
    for time in (0.5, 2.2, 1.0):
        moving.move(time, 0.1)
        placed_cells = CutCells(
            grid,
            [resting[0], placed(geometry.moved(motion.pose(time))), resting[1]],
            wall_separating=True,
        )
        for one, other in zip(fields_of(moving), fields_of(placed_cells), strict=True):
            np.testing.assert_array_equal(one, other)
        assert moving.dropped == placed_cells.dropped
        for velocity, wall, open_, before in zip(
            moving.velocity, moving.wall, moving.open, alone.open, strict=True
        ):
            as_before = (open_.numpy() == before.numpy()) & (wall.numpy() != 0)
            # At most the velocity of a dropped fraction.
            assert (np.abs(velocity.numpy()[as_before]) < 2e-3).all()


def test_solids_that_stand_still_ignore_moves():
    cut = cut_cells(grid_of(2), Sphere(center=[0.4, 0.3], radius=0.2))
    before = [field.copy() for field in fields_of(cut)]
    cut.move(1.0, 0.1)
    assert cut.velocity is None
    assert not cut.moves
    for one, other in zip(before, fields_of(cut), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_solid_may_come_in_later():
    sphere = placed(Sphere(center=[-2.0, 0.3], radius=0.2), motion=Translation(velocity=[1.0, 0.0]))
    cut = CutCells(grid_of(2), [sphere], wall_separating=True)
    assert (cut.open[0].numpy()[1, 1:-1, 2:-1] == 1.0).all()
    cut.move(2.4, 0.1)
    assert (cut.open[0].numpy()[1, 1:-1, 2:-1] == 0.0).any()
    assert cut.velocity[0].numpy().max() == pytest.approx(1.0)
    cut.move(9.0, 0.1)  # and leave
    assert (cut.open[0].numpy()[1, 1:-1, 2:-1] == 1.0).all()
    assert (cut.velocity[0].numpy() == 0.0).all()


@pytest.mark.parametrize("dimension", [2, 3])
def test_parts_of_a_resting_solid_under_a_moving_one_have_no_velocity(dimension):
    """No motion of the part of a resting solid that a moving one covers.

    A piston slides over a floor 0.37 cells above faces: 0.63 of its front's lowest faces displace
    liquid, and nothing within the floor does. If the whole face moved, the liquid would be pushed
    at 1.6 times the piston's speed there.
    """
    grid = grid_of(dimension, (12, 9, 7), 0.1)
    piston = Box(lower=[-9.0] * dimension, upper=[0.44, 9.0, 9.0][:dimension])
    floor = Box(lower=[-9.0] * dimension, upper=[9.0, 0.237, 9.0][:dimension])
    solids = [placed(piston, motion=Translation(velocity=[2.0, 0.0])), placed(floor)]
    for order in (solids, solids[::-1]):
        cut = CutCells(grid, order, wall_separating=True)
        cut.set_velocity(0.0, 0.01)
        displaced = (cut.velocity[0].numpy() * (1.0 - cut.open[0].numpy()))[
            1 : 1 + (1 if dimension == 2 else 7), 1:-1
        ]
        np.testing.assert_allclose(displaced[:, 2, 1:5], 1.26, atol=1e-4)
        np.testing.assert_allclose(displaced[:, 3:, 1:5], 2.0, atol=1e-4)
        np.testing.assert_allclose(displaced[:, :2], 0.0, atol=1e-4)
        assert (displaced[:, :, 6] < 0.05).all()  # the corner is rounded off
        np.testing.assert_array_equal(displaced[:, :, 7:], 0.0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_solid_may_be_near_the_ring_alone(dimension):
    """Solid near the ring alone.

    A node outside the domain is near it, but no face inside: nothing is filled, and there is no
    division by 0.
    """
    grid = grid_of(dimension, (6, 5, 4), 0.1)
    for corner in ([-1.0, 0.2, 0.2], [0.3, 0.9 + 0.05, 0.2], [0.3, 0.2, -0.55]):
        ball = placed(
            Sphere(center=corner[:dimension], radius=0.05), motion=Translation(velocity=[0.1, 0.0])
        )
        cut = CutCells(grid, [ball], wall_separating=True)
        for time in np.linspace(0.0, 8.0, 33):
            cut.place(time)
            cut.set_velocity(time, 0.1)
            assert all((np.abs(field.numpy()) <= 0.1 + 1e-6).all() for field in cut.velocity)
