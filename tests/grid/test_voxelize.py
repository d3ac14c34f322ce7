from pathlib import Path

import numpy as np
import pytest
import warp as wp
from cut_cell_tools import placed
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_lcp.grid import node_distance
from warp_lcp.grid import voxelize as voxelize_module
from warp_lcp.grid.signed_distance import Box, Capsule, Placement, Plane, Sphere, TriangleMesh
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.triangle_mesh import builtin_mesh
from warp_lcp.grid.voxelize import PlacedSolid, inside, placement_notes, voxelize

SPOT = Path(__file__).resolve().parents[2] / "../shared/data/spot.obj"


def cells(counts, spacing, dimension, *solids):
    return voxelize(StaggeredGrid(counts, spacing, dimension), solids, wall_separating=False)


def test_empty_domain_has_a_ring_of_wall():
    voxels = cells((4, 3, 2), 0.1, 3)
    index = voxels.index.numpy()
    assert index.shape == (4, 5, 6)
    assert (index[1:-1, 1:-1, 1:-1] == -1).all()
    index[1:-1, 1:-1, 1:-1] = 0
    assert (index == 0).all()
    assert voxels.names == ("domain",)
    assert voxels.separating.numpy().tolist() == [0]
    assert voxels.notes == ()


def test_index_order_and_the_first_claim():
    floor = Plane(point=[0.0, 0.2, 0.0], normal=[0.0, 1.0, 0.0])
    box = Box(lower=[0.3, 0.0, 0.1], upper=[0.5, 0.4, 0.2])
    voxels = cells(
        (6, 5, 4), 0.1, 3, placed(floor, separating=False, name="floor"), placed(box, name="box")
    )
    expected = np.zeros((6, 7, 8), dtype=np.int32)
    expected[1:-1, 1:-1, 1:-1] = -1
    expected[1:-1, 1:3, 1:-1] = 1
    expected[2, 3:5, 4:6] = 2
    np.testing.assert_array_equal(voxels.index.numpy(), expected)
    assert voxels.covered == (48, 8)
    assert voxels.names == ("domain", "floor", "box")
    assert voxels.separating.numpy().tolist() == [0, 0, 1]
    assert voxels.index.dtype == wp.int32


def test_sphere_fills_its_volume():
    sphere = Sphere(center=[0.5, 0.5, 0.5], radius=0.4)
    covered = cells((50, 50, 50), 0.02, 3, placed(sphere)).covered[0]
    assert covered * 0.02**3 == pytest.approx(4.0 / 3.0 * np.pi * 0.4**3, rel=0.005)


def test_disc_fills_its_area_in_one_layer():
    disc = Sphere(center=[0.5, 0.25], radius=0.2)
    voxels = cells((200, 100, 1), 0.005, 2, placed(disc))
    assert voxels.covered[0] * 0.005**2 == pytest.approx(np.pi * 0.2**2, rel=0.005)
    index = voxels.index.numpy()
    assert index.shape == (3, 102, 202)
    assert (index[[0, 2]] == 0).all()
    assert (index[1] == 1).sum() == voxels.covered[0]


@pytest.mark.parametrize("dimension", [2, 3])
def test_inverted_sphere_is_a_container(dimension):
    counts = (40, 40, 40 if dimension == 3 else 1)
    container = Sphere(center=[0.5] * dimension, radius=0.45, invert=True)
    open_cells = (cells(counts, 1.0 / 40.0, dimension, placed(container)).index.numpy() == -1).sum()
    exact = np.pi * 0.45**2 if dimension == 2 else 4.0 / 3.0 * np.pi * 0.45**3
    assert open_cells / 40.0**dimension == pytest.approx(exact, rel=0.01)


@given(
    center=st.tuples(*[st.floats(0.0, 1.0)] * 3),
    angles=st.tuples(*[st.floats(0.0, 360.0)] * 3),
    scale=st.floats(0.05, 3.0),
    shape=st.sampled_from(
        [
            Box(lower=[-0.3, -0.1, -0.2], upper=[0.3, 0.1, 0.2]),
            Capsule(start=[0.0, -0.2, 0.1], end=[0.2, 0.3, 0.0], radius=0.1),
        ]
    ),
    chunk=st.sampled_from([1, 100, 1 << 20]),
)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_every_cell_is_claimed_by_its_center(center, angles, scale, shape, chunk):
    placement = Placement.from_degrees(scale, angles, center, 3)
    geometry = type(shape)(**{**vars(shape), "placement": placement})
    counts, spacing = (10, 8, 9), 0.1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(voxelize_module, "CHUNK", chunk)
        patch.setattr(node_distance, "CHUNK", chunk)
        host = np.stack(
            np.meshgrid(*(spacing * (np.arange(n) + 0.5) for n in counts), indexing="ij"), axis=-1
        )
        claimed = inside(
            [geometry], np.asarray(host.reshape(-1, 3), dtype=np.float32), device="cpu"
        ).reshape(counts)
        if claimed.all():
            return
        try:
            voxels = cells(counts, spacing, 3, placed(geometry))
        except ValueError as error:
            assert "wholly outside" in str(error)
            assert not claimed.any()
            return
    np.testing.assert_array_equal(
        voxels.index.numpy()[1:-1, 1:-1, 1:-1] == 1, claimed.transpose(2, 1, 0)
    )
    assert voxels.covered == (int(claimed.sum()),)


def test_a_solid_between_cell_centers_is_reported():
    voxels = cells(
        (10, 10, 1),
        0.1,
        2,
        placed(Sphere(center=[0.5, 0.5], radius=0.04), name="solid[0] (sphere)"),
    )
    assert voxels.covered == (0,)
    assert voxels.notes == (
        "solid[0] (sphere) is too small for the grid: no center of a cell of 0.1 m lies inside it",
    )


def test_solids_that_leave_no_cell_are_refused():
    with pytest.raises(ValueError, match="no open cell is left"):
        cells((5, 5, 1), 0.2, 2, placed(Plane(point=[0.0, 2.0], normal=[0.0, 1.0])))


@pytest.mark.parametrize(
    ("geometry", "dimension"),
    [
        (Sphere(center=[2.0, 0.5], radius=0.5), 2),
        (Box(lower=[0.0, -1.0], upper=[1.0, -0.5]), 2),
        (Sphere(center=[0.5, 0.5, 5.0], radius=0.5), 3),
    ],
)
def test_a_solid_outside_the_domain_is_refused(geometry, dimension):
    counts = (10, 10, 10 if dimension == 3 else 1)
    with pytest.raises(ValueError, match=r"solid\[0\] lies wholly outside the domain: it spans"):
        cells(counts, 0.1, dimension, placed(geometry))


def test_a_solid_that_has_moved_may_be_anywhere():
    """Moved solids anywhere: outside the domain, or over all of it.

    With remarks off neither is refused, and nothing is noted.
    """
    outside = PlacedSolid(
        geometry=Sphere(center=[9.0, 9.0], radius=0.2), separating=True, name="ball"
    )
    found = voxelize(
        StaggeredGrid((4, 4, 1), 0.25, 2), [outside], wall_separating=True, remarks=False
    )
    assert (found.index.numpy()[1, 1:-1, 1:-1] == -1).all()
    everywhere = PlacedSolid(
        geometry=Sphere(center=[0.5, 0.5], radius=9.0), separating=True, name="ball"
    )
    found = voxelize(
        StaggeredGrid((4, 4, 1), 0.25, 2), [everywhere], wall_separating=True, remarks=False
    )
    assert (found.index.numpy()[1, 1:-1, 1:-1] == 1).all()
    assert found.notes == ()


def test_a_mesh_that_misses_the_plane_of_two_dimensions_is_refused():
    mesh = TriangleMesh(
        surface=builtin_mesh("torus"), placement=Placement(translation=[0.5, 0.5, 0.2])
    )
    with pytest.raises(ValueError, match=r"misses z = 0"):
        cells((10, 10, 1), 0.1, 2, placed(mesh))


def test_a_mesh_is_cut_in_two_dimensions():
    mesh = TriangleMesh(
        surface=builtin_mesh("torus"), placement=Placement(translation=[0.6, 0.6, 0.0])
    )
    voxels = cells((120, 120, 1), 0.01, 2, placed(mesh))
    assert voxels.covered[0] * 0.01**2 == pytest.approx(np.pi * (0.5**2 - 0.2**2), rel=0.01)
    assert voxels.notes == ()


def test_a_mesh_that_sticks_out_is_reported():
    mesh = TriangleMesh(
        surface=builtin_mesh("torus"), placement=Placement(translation=[0.2, 0.5, 0.5])
    )
    assert placement_notes(mesh, "cow", StaggeredGrid((50, 50, 50), 0.02, 3)) == [
        "cow reaches 0.3 m out of the domain; the part outside has no effect"
    ]
    assert (
        placement_notes(
            Sphere(center=[0.0, 0.5, 0.5], radius=0.3),
            "sphere",
            StaggeredGrid((50, 50, 50), 0.02, 3),
        )
        == []
    )


def test_a_mesh_thinner_than_a_cell_is_reported():
    thin = TriangleMesh(
        surface=builtin_mesh("knot"), placement=Placement(translation=[0.5, 0.5, 0.5])
    )
    (note,) = cells((5, 5, 5), 0.2, 3, placed(thin, name="knot")).notes
    assert "knot is thinner than a cell of 0.2 m under 100% of its surface" in note
    assert cells((32, 32, 32), 1.0 / 32.0, 3, placed(thin)).notes == ()


def test_inside_is_the_union_in_chunks(monkeypatch):
    monkeypatch.setattr(voxelize_module, "CHUNK", 700)
    points = np.random.default_rng(3391).uniform(-1.0, 1.0, (5000, 3))
    sphere = Sphere(center=[0.3, 0.0, 0.0], radius=0.5)
    above = Plane(point=[0.0, 0.4, 0.0], normal=[0.0, -1.0, 0.0])
    expected = (np.linalg.norm(points - [0.3, 0.0, 0.0], axis=1) < 0.5) | (points[:, 1] > 0.4)
    np.testing.assert_array_equal(inside([sphere, above], points, device="cpu"), expected)
    assert not inside([], points, device="cpu").any()
    assert inside([sphere], np.empty((0, 3)), device="cpu").shape == (0,)
    with pytest.raises(ValueError, match=r"shape \(m, 3\)"):
        inside([sphere], points[:, :2], device="cpu")


@pytest.mark.skipif(not SPOT.exists(), reason="../shared/data/spot.obj is not there")
def test_spot_fills_its_volume():
    placement = Placement.from_degrees(0.5, [0.0, 35.0, 0.0], [0.5, 0.45, 0.5], 3)
    mesh = TriangleMesh.from_file(str(SPOT), placement=placement)
    voxels = cells((64, 64, 64), 1.0 / 64.0, 3, placed(mesh))
    assert voxels.covered[0] / 64.0**3 == pytest.approx(mesh.volume, rel=0.03)
    assert not [note for note in voxels.notes if "out of the domain" in note]
