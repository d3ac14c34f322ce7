import itertools

import numpy as np
import pytest
import warp as wp
from cut_cell_tools import (
    DIRECTIONS,
    MOVING,
    SPACING,
    FunctionSolid,
    area_of,
    clip,
    cut_cells,
    face_polygon,
    fields_of,
    grid_of,
    interior_faces,
    placed,
    tilted,
)

import warp_lcp as wl
from warp_lcp.grid import node_distance, staggered
from warp_lcp.grid.node_distance_kernels import FAR
from warp_lcp.grid.signed_distance import Box, Placement, Plane, Sphere, TriangleMesh
from warp_lcp.grid.voxelize import voxelize


@pytest.mark.default_cases(6)
@pytest.mark.parametrize(
    ("dimension", "direction"), [(d, n) for d in (2, 3) for n in DIRECTIONS[d]]
)
def test_fractions_are_exact_for_planes(dimension, direction):
    grid = grid_of(dimension)
    plane, normal, offset = tilted(dimension, direction)
    cut = cut_cells(grid, plane)
    normal = np.array([*normal, 0.0][:3])
    seen = 0
    for axis in range(dimension):
        computed, wall = cut.open[axis].numpy(), cut.wall[axis].numpy()
        outside = np.ones(grid.shape, dtype=bool)
        for i, j, k in interior_faces(grid, axis):
            exact = area_of(clip(face_polygon(axis, i, j, k), normal, offset))
            outside[k, j, i] = False
            if exact < 0.999e-3:
                assert computed[k, j, i] == 0.0
            elif exact > 1.001e-3:
                assert computed[k, j, i] == pytest.approx(exact, abs=1e-5)
            assert wall[k, j, i] == (-1 if computed[k, j, i] == 1.0 else 1)
            seen += 0.0 < exact < 1.0
        assert (computed[outside] == 0.0).all()  # the domain's faces, and everything outside
        assert (wall[outside] == 0).all()
    # A plane between nodes cuts the faces across it in at least one layer.
    assert seen >= 6
    assert not cut.whole_cells
    assert cut.dropped == 0


@pytest.mark.default_cases(6)
@pytest.mark.parametrize(
    ("dimension", "direction"), [(d, n) for d in (2, 3) for n in DIRECTIONS[d]]
)
def test_open_faces_and_wall_close_every_cell(dimension, direction):
    """Closure of every cell by open faces and wall.

    The area vectors of the open parts of a cell's faces and of the wall within it sum to zero.
    """
    grid = grid_of(dimension)
    plane, normal, offset = tilted(dimension, direction)
    cut = cut_cells(grid, plane)
    fields = [field.numpy() for field in cut.open]
    normal3 = np.array([*normal, 0.0][:3])
    cells = itertools.product(
        *(range(2, count) for count in grid.counts[:dimension]), *([[1]] if dimension == 2 else [])
    )
    walls = 0
    for i, j, k in cells:
        upper = [fields[a][k + (a == 2), j + (a == 1), i + (a == 0)] for a in range(dimension)]
        open_area = np.array([upper[a] - fields[a][k, j, i] for a in range(dimension)])
        wall = wall_area(np.array([i, j, k], dtype=np.float64), normal3, offset, dimension)
        walls += wall > 0.0
        # A dropped face changes the sum by 1e-3.
        np.testing.assert_allclose(open_area, wall * normal, atol=3e-3 if wall else 1e-6)
    assert walls > 0


def wall_area(low, normal, offset, dimension):
    """Return the area (in 2-D length) of the plane n.x = offset in a cell at `low`.

    A large square of the plane is clipped by the cell.
    """
    across = np.linalg.svd(normal[None])[2][1:]
    center = low + 0.5
    center = center - (normal @ center - offset) * normal
    square = center + 10.0 * np.array(
        [
            across[0] + across[1],
            across[1] - across[0],
            -across[0] - across[1],
            across[0] - across[1],
        ]
    )
    if dimension == 2:
        square[:, 2] = np.clip(square[:, 2], low[2], low[2] + 1.0)
    for axis in range(3):
        unit = np.eye(3)[axis]
        for n, o in ((unit, low[axis]), (-unit, -low[axis] - 1.0)):
            if len(square):
                square = clip(square, n, o - 1e-12)
    return area_of(square)


@pytest.mark.parametrize("dimension", [2, 3])
def test_slices_of_a_ball_converge_with_second_order(dimension):
    center, radius, errors = np.array([0.52, 0.47, 0.49])[:dimension], 0.31, []
    for cells in (16, 32, 64):
        grid = grid_of(dimension, (cells,) * 3, 1.0 / cells)
        cut = cut_cells(grid, Sphere(center=center, radius=radius))
        worst = 0.0
        for axis in range(dimension):
            open_area = grid.interior(cut.open[axis].numpy()).sum(
                axis=tuple(n for n in range(3) if n != 2 - axis)
            ) / cells ** (dimension - 1)
            half = np.sqrt(
                np.maximum(radius**2 - (np.arange(cells) / cells - center[axis]) ** 2, 0.0)
            )
            exact = 1.0 - (2.0 * half if dimension == 2 else np.pi * half**2)
            worst = max(worst, float(np.abs(open_area - exact)[1:].mean()))
        errors.append(worst)
    slopes = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[-1] < 2e-3
    assert slopes.mean() > 1.7  # the two slices that only touch the ball are of order 1.5


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("value", [-0.01, 0.01])
def test_the_mean_decides_saddles(dimension, value):
    """Resolution of saddles by the mean.

    On faces across z (in 2-D there is none) d = x y + value has open corners across; with a
    positive mean they are connected.
    """
    grid = grid_of(dimension, (4, 4, 4), 1.0)
    if dimension == 2:
        saddle = FunctionSolid(lambda p: (p[:, 0] - 1.5) * (p[:, 1] - 1.5) + value)
        cut = cut_cells(grid, saddle)
        # d at the corners of cell (2, 2): 1/4 + value and -1/4 + value; an edge is open on one
        # side.
        np.testing.assert_allclose(
            cut.open[0].numpy()[1, 2, 2:4], 0.5 + 2.0 * value * np.ones(2), atol=1e-6
        )
        return
    cut = cut_cells(grid, FunctionSolid(lambda p: (p[:, 0] - 1.5) * (p[:, 1] - 1.5) + value))
    part = 0.5 + 2.0 * abs(value)
    expected = 1.0 - (1.0 - part) ** 2 if value > 0.0 else (1.0 - part) ** 2
    assert cut.open[2].numpy()[3, 2, 2] == pytest.approx(expected, abs=1e-6)


def test_mesh_agrees_with_samples_of_its_faces():
    grid = grid_of(3, (36, 36, 20), 0.03)
    mesh = TriangleMesh.from_file(
        "builtin:torus",
        placement=Placement.from_degrees(0.9, [20.0, 10.0, 0.0], [0.54, 0.53, 0.31], 3),
    )
    cut = cut_cells(grid, mesh)
    rng = np.random.default_rng(20)
    samples = (np.arange(24) + 0.5) / 24
    errors = []
    for axis in range(3):
        computed = cut.open[axis].numpy()
        inside = [slice(2 if a == axis else 1, -1) for a in range(3)]
        partial = np.argwhere((computed > 0.0) & (computed < 1.0))
        whole = np.argwhere(np.pad(computed[inside[2], inside[1], inside[0]], 0) >= 0.0) + [
            s.start for s in inside[::-1]
        ]
        for k, j, i in np.concatenate([rng.permutation(partial)[:60], rng.permutation(whole)[:60]]):
            p, q = (other for other in range(3) if other != axis)
            points = np.tile(np.array([i, j, k], dtype=np.float64), (len(samples) ** 2, 1))
            a, b = np.meshgrid(samples, samples)
            points[:, p] += a.ravel()
            points[:, q] += b.ravel()
            distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
            mesh.signed_distance(
                wp.array(grid.to_world(points), dtype=wp.vec3, device="cpu"), distance
            )
            errors.append(computed[k, j, i] - (distance.numpy() > 0.0).mean())
    # Not the largest: a face that the surface grazes between its corners may be far off.
    assert np.quantile(np.abs(errors), 0.95) < 0.05
    assert np.abs(errors).mean() < 0.01


BOXES = {
    "box": [Box(lower=[0.2, 0.0], upper=[0.5, 0.3])],
    "slab of one cell": [Box(lower=[0.0, 0.0], upper=[0.8, 0.1])],
    "plate of one cell": [Box(lower=[0.0, 0.3], upper=[0.5, 0.4])],
    "gap of one cell": [
        Box(lower=[0.0, 0.3], upper=[0.3, 0.7]),
        Box(lower=[0.4, 0.2], upper=[0.8, 0.7]),
    ],
    "step on a floor": [
        Box(lower=[-1.0, -1.0], upper=[2.0, 0.2]),
        Box(lower=[0.3, 0.2], upper=[0.5, 0.5]),
    ],
    "container": [Box(lower=[0.1, 0.1], upper=[0.7, 0.6], invert=True)],
    "turned": [
        Box(
            lower=[-0.1, -0.2],
            upper=[0.1, 0.2],
            placement=Placement.from_degrees(1.0, 90.0, [0.4, 0.3], 2),
        )
    ],
}


def in_space(box):
    """Return the same box with a limited third direction."""
    lower, upper = (0.1, 0.4) if box.lower[0] > -1.0 else (-1.0, 2.0)
    placement = Placement(rotation=box.placement.rotation, translation=box.placement.translation)
    return Box(
        lower=[*box.lower, lower], upper=[*box.upper, upper], invert=box.invert, placement=placement
    )


@pytest.mark.default_cases(21)
@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", [1.0, 1.0 / 7.0, 12.7])
def test_boxes_of_whole_cells_leave_whole_cells(name, dimension, size):
    """Boxes of whole cells: cells and faces of `voxelize`.

    Rounding of the nodes' positions must not show.
    """
    solids = [box if dimension == 2 else in_space(box) for box in BOXES[name]]
    if size != 1.0:
        scaled = [
            Placement(
                scale=size,
                rotation=b.placement.rotation,
                translation=size * b.placement.translation,
            )
            for b in solids
        ]
        solids = [
            Box(lower=b.lower, upper=b.upper, invert=b.invert, placement=p)
            for b, p in zip(solids, scaled, strict=True)
        ]
    grid = grid_of(dimension, (8, 7, 6), SPACING * size)
    cut = cut_cells(grid, *solids)
    index = voxelize(grid, [placed(box) for box in solids], wall_separating=False).index.numpy()
    assert cut.whole_cells
    assert cut.dropped == 0
    np.testing.assert_array_equal(
        grid.interior(cut.base.numpy()), np.where(grid.interior(index) < 0, wl.AIR, wl.SOLID)
    )
    assert (np.delete(cut.base.numpy(), range(1, grid.counts[0] + 1), axis=2) == wl.SOLID).all()
    for axis in range(dimension):
        below = np.roll(index, 1, axis=2 - axis)
        inside = tuple(slice(2 if a == axis else 1, -1) for a in (2, 1, 0))
        open_face = (index < 0) & (below < 0)
        computed, wall = cut.open[axis].numpy(), cut.wall[axis].numpy()
        np.testing.assert_array_equal(computed[inside], open_face[inside])
        # A face between an open cell and a solid one belongs to that solid.
        owner = np.where(
            index < 0, below, np.where(below < 0, index, np.where(index == below, index, -5))
        )
        known = (owner[inside] > -5) & (owner[inside] != 0)
        np.testing.assert_array_equal(wall[inside][known], owner[inside][known])
    expected = kernel_sums(index < 0, dimension)
    np.testing.assert_allclose(
        grid.interior(cut.capacity.numpy()), grid.interior(expected), atol=1e-6
    )


def kernel_sums(open_cells, dimension):
    """Return the quadratic B-spline's integral over open cells.

    Its weights are 1/6, 2/3, 1/6 along each axis.
    """
    result = open_cells.astype(np.float64)
    for axis in range(3 - dimension, 3):
        result = (np.roll(result, 1, axis) + np.roll(result, -1, axis)) / 6.0 + result * (2.0 / 3.0)
    return result


def line_distribution(normal, offset, points=240):
    """Return the open share {n.x > offset} of a kernel about the origin.

    It is the exact integral along one axis and the midpoint rule across.
    """
    dimension, main = len(normal), int(np.argmax(np.abs(normal)))
    at = (np.arange(points) + 0.5) * (3.0 / points) - 1.5
    across = np.meshgrid(*[at] * (dimension - 1), indexing="ij")
    weight = np.prod(
        [np.where(np.abs(x) < 0.5, 0.75 - x**2, 0.5 * (1.5 - np.abs(x)) ** 2) for x in across],
        axis=0,
    )
    weight = weight * (3.0 / points) ** (dimension - 1)
    rest = offset - sum(n * x for n, x in zip(np.delete(normal, main), across, strict=True))
    x = np.clip(rest / normal[main], -1.5, 1.5)
    below = np.where(
        x < -0.5,
        (x + 1.5) ** 3 / 6.0,
        np.where(x < 0.5, 0.5 + 0.75 * x - x**3 / 3.0, 1.0 - (1.5 - x) ** 3 / 6.0),
    )
    return float((weight * (1.0 - below if normal[main] > 0.0 else below)).sum())


@pytest.mark.default_cases(6)
@pytest.mark.parametrize(
    ("dimension", "direction"), [(d, n) for d in (2, 3) for n in DIRECTIONS[d]]
)
def test_capacity_of_planes(dimension, direction):
    grid = grid_of(dimension)
    plane, normal, offset = tilted(dimension, direction)
    capacity = cut_cells(grid, plane).capacity.numpy()
    cells = list(
        itertools.product(
            *(range(2, count) for count in grid.counts[:dimension]),
            *([[1]] if dimension == 2 else []),
        )
    )
    errors = []
    for i, j, k in cells:
        exact = line_distribution(
            normal,
            offset - float(normal @ (np.array([i, j, k])[:dimension] + 0.5)),
            240 if dimension == 2 else 80,
        )
        errors.append(capacity[k, j, i] - exact)
    assert np.abs(errors).max() < 5e-4


def test_capacity_of_a_disc_and_the_walls_beside_it():
    grid = grid_of(2, (20, 16), 0.05)
    disc = Sphere(center=[0.12, 0.31], radius=0.22)  # cut by the domain's left wall
    capacity = cut_cells(grid, disc).capacity.numpy()[1, 1:-1, 1:-1]
    fine = 20
    x, y = (0.05 * ((np.arange(n * fine) + 0.5) / fine) for n in (20, 16))
    open_part = np.hypot(x[None] - 0.12, y[:, None] - 0.31) > 0.22
    kernels = [
        np.array([np.interp(np.abs(c - at), *table()) for c in 0.05 * (np.arange(n) + 0.5)]) / fine
        for n, at in ((20, x), (16, y))
    ]
    exact = kernels[1] @ open_part @ kernels[0].T
    # Chords in place of arcs leave 1 / (12 radius) too much open area along the wall.
    assert np.abs(capacity - exact).max() < 0.02
    assert np.abs(capacity - exact).mean() < 2e-3


def table():
    """Return the quadratic B-spline over distances [m] of a grid of 0.05 m."""
    r = np.linspace(0.0, 1.6, 3201)
    return 0.05 * r, np.where(r < 0.5, 0.75 - r**2, np.where(r < 1.5, 0.5 * (1.5 - r) ** 2, 0.0))


def test_capacities_add_up_to_the_open_volume():
    """Sum of capacities: the open volume.

    The kernels of all cells, including the ring, sum to 1 everywhere; a mesh's volume is known from
    its triangles.
    """
    errors = []
    for cells in (20, 40):
        grid = grid_of(3, (cells, cells, cells // 2), 1.2 / cells)
        mesh = TriangleMesh.from_file(
            "builtin:torus",
            placement=Placement.from_degrees(0.9, [20.0, 10.0, 0.0], [0.61, 0.58, 0.31], 3),
        )
        capacity = cut_cells(grid, mesh).capacity.numpy().astype(np.float64)
        solid = np.prod(grid.counts) - capacity.sum()
        errors.append(abs(solid * grid.cell_volume / mesh.volume - 1.0))
    assert errors[0] < 0.06
    assert errors[1] < 0.3 * errors[0]


def test_a_mesh_is_cut_in_two_dimensions():
    torus = TriangleMesh.from_file(
        "builtin:torus", placement=Placement(translation=[0.6, 0.6, 0.0])
    )
    grid = grid_of(2, (60, 60), 0.02)
    solid = 3600.0 - cut_cells(grid, torus).capacity.numpy()[1].sum(dtype=np.float64)
    assert solid * grid.cell_volume == pytest.approx(np.pi * (0.5**2 - 0.2**2), rel=0.01)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_thread_a_cell_finds_the_same(dimension):
    """Equal results with one thread per cell.

    CUDA runs the kernels so: no thread may rely on another of its row.
    """
    solids = [geometry for geometry, _ in MOVING[dimension]]
    grid = grid_of(dimension, (12, 9, 7), 0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(staggered, "grain", lambda n, device: 1)
        single = cut_cells(grid_of(dimension, (12, 9, 7), 0.1), *solids)
    for one, other in zip(fields_of(cut_cells(grid, *solids)), fields_of(single), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_capacity_can_be_left_out():
    assert (
        cut_cells(grid_of(2), Sphere(center=[0.4, 0.3], radius=0.2), capacity=False).capacity
        is None
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_distance_is_exact_near_walls_and_large_elsewhere(dimension):
    grid = grid_of(dimension, (40, 36, 30), 0.05)
    center = np.array([0.9, 0.8, 0.7])[:dimension]
    cut = cut_cells(grid, Sphere(center=center, radius=0.33))
    axes = [np.arange(n) - 1.0 for n in grid.shape]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    nodes = np.stack([x, y, z], axis=-1)[..., :dimension]
    exact = np.linalg.norm(nodes - center / 0.05, axis=-1) - 0.33 / 0.05
    used = slice(None) if dimension == 3 else slice(1, 2)
    computed, exact = cut.distance.numpy()[used], exact[used]
    near = exact < FAR
    np.testing.assert_allclose(computed[near], exact[near], atol=1e-4)
    assert (computed[~near] >= FAR).all()


def test_groups_of_nodes_measure_a_mesh_as_single_nodes_do():
    grid = grid_of(3, (60, 54, 28), 0.02)
    mesh = TriangleMesh.from_file(
        "builtin:torus", placement=Placement(translation=[0.61, 0.55, 0.3])
    )
    grouped = cut_cells(grid, mesh).distance.numpy()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(node_distance, "COARSE", 1)
        patch.setattr(node_distance, "CHUNK", 1000)
        single = cut_cells(grid, mesh).distance.numpy()
    near = np.abs(single) < FAR
    assert 0.2 < near.mean() < 0.95
    np.testing.assert_array_equal(grouped[near], single[near])
    assert (np.abs(grouped[~near]) >= FAR).all()
    assert (np.sign(grouped) == np.sign(single)).all()


def test_faces_belong_to_the_solid_nearest_to_their_centers():
    grid = grid_of(3, (16, 14, 12), 0.1)
    shapes = [
        Plane(point=[0.0, 0.33, 0.0], normal=[0.1, 1.0, 0.0]),
        Sphere(center=[0.7, 0.55, 0.6], radius=0.31),
        Box(
            lower=[-0.2, -0.3, -0.2],
            upper=[0.2, 0.3, 0.2],
            placement=Placement.from_degrees(1.0, [10.0, 20.0, 30.0], [1.1, 0.5, 0.6], 3),
        ),
    ]
    cut = cut_cells(grid, *shapes)
    counts = np.zeros(4, dtype=int)
    for axis in range(3):
        inside = tuple(slice(2 if a == axis else 1, -1) for a in (2, 1, 0))
        wall = cut.wall[axis].numpy()[inside]
        k, j, i = np.meshgrid(
            *(np.arange(s.start, n - 1) for s, n in zip(inside, grid.shape, strict=True)),
            indexing="ij",
        )
        center = np.stack([i, j, k], axis=-1) + 0.5 * (np.arange(3) != axis)
        points = wp.array(grid.to_world(center.reshape(-1, 3)), dtype=wp.vec3, device="cpu")
        distances = []
        for shape in shapes:
            distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
            shape.signed_distance(points, distance)
            distances.append(distance.numpy().reshape(wall.shape))
        distances = np.stack(distances)
        assert ((wall >= 1) == (cut.open[axis].numpy()[inside] < 1.0)).all()
        chosen = np.take_along_axis(distances, np.maximum(wall - 1, 0)[None].astype(int), axis=0)[0]
        closed = wall >= 1
        # Distances within a third of a cell count as equal.
        assert (chosen - distances.min(axis=0))[closed].max() < 0.03
        counts += np.bincount(wall[closed], minlength=4)
    assert (counts[1:] > 20).all()


def test_an_empty_domain():
    cut = cut_cells(grid_of(2, (4, 3)))
    assert cut.whole_cells
    assert cut.names == ("domain",)
    assert cut.notes == ()
    np.testing.assert_array_equal(cut.open[0].numpy()[1, 1:4, 2:5], 1.0)
    assert (cut.distance.numpy() >= FAR).all()
    assert cut.separating.numpy().tolist() == [0]


def test_slivers_are_dropped_and_counted():
    """Slivers, dropped and counted.

    The plane leaves 5e-4 of a cell open above nodes: closed, and never more open than before.
    """
    grid = grid_of(2, (6, 5))
    cut = cut_cells(grid, Plane(point=[0.0, 0.29995], normal=[0.0, 1.0]))
    x = cut.open[0].numpy()[1]
    assert (x[3, 2:7] == 0.0).all()
    assert (x[4, 2:7] == 1.0).all()
    assert cut.dropped == 5
    assert cut.notes == ("5 faces are less than 0.001 open and count as closed",)
    # Their cells keep the open faces above and are not SOLID.
    assert (cut.base.numpy()[1, 3, 1:7] == wl.AIR).all()
    assert (cut.base.numpy()[1, 2, 1:7] == wl.SOLID).all()


def test_solids_without_effect_are_reported():
    cut = cut_cells(
        grid_of(2), Sphere(center=[0.45, 0.35], radius=0.03), Sphere(center=[0.4, 0.3], radius=0.03)
    )
    assert cut.notes == (
        "solid[0] closes no part of a face: it is too small for cells of 0.1 m, or lies in other "
        "solids",
    )


def test_thin_meshes_are_reported():
    torus = TriangleMesh.from_file(
        "builtin:torus", placement=Placement(scale=0.5, translation=[0.4, 0.4, 0.3])
    )
    notes = cut_cells(grid_of(3, (8, 8, 6), 0.2), torus).notes
    assert any("is thinner than a cell of 0.2 m" in note for note in notes)


@pytest.mark.parametrize(
    ("geometry", "match"),
    [
        (Sphere(center=[2.0, 0.5], radius=0.5), "wholly outside"),
        (Plane(point=[0.0, 2.0], normal=[0.0, 1.0]), "no open cell is left"),
    ],
)
def test_solids_outside_or_everywhere_are_refused(geometry, match):
    with pytest.raises(ValueError, match=match):
        cut_cells(grid_of(2), geometry)
