"""Surfaces of material up to the true walls of solids in any position."""

import numpy as np
import pytest
import warp as wp

from mesh_checks import assert_closed, enclosed
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.mesh_walls import OVERLAP
from warp_lcp.grid.motion import Translation
from warp_lcp.grid.particle_seeding import lattice
from warp_lcp.grid.signed_distance import Box, Geometry, Placement, Plane, Sphere
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.surface_mesh import SurfaceMesh, SurfaceObstacles
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.material.boundary import CutBoundary

DX, COUNT = 0.05, 13
KINDS = ("plane", "ball", "bowl", "box", "inside of a box")
SEEDS = (5101, 5102)


def turned(rng: np.random.Generator, dimension: int) -> np.ndarray:
    """Return a random rotation."""
    q, r = np.linalg.qr(rng.normal(size=(dimension, dimension)))
    q *= np.sign(np.diag(r))
    q[:, 0] *= np.sign(np.linalg.det(q))
    rotation = np.eye(3)
    rotation[:dimension, :dimension] = q
    return rotation


def some_solid(kind: str, seed: int, dimension: int) -> tuple[Geometry, float | None]:
    """Return a solid, and the volume [cells] of its complement in the domain.

    The complement is widened by `OVERLAP`. The volume is None if there is no formula.
    """
    rng = np.random.default_rng(seed)
    middle = np.zeros(3)
    middle[:dimension] = 0.5 * COUNT + rng.uniform(-1.0, 1.0, dimension)
    whole = float(COUNT**dimension)
    match kind:
        case "plane":
            normal = np.zeros(3)
            normal[:dimension] = rng.normal(size=dimension)
            return Plane(point=(middle - normal) * DX, normal=normal), None
        case "ball" | "bowl":
            radius = rng.uniform(3.0, 5.0)
            r = radius + (OVERLAP if kind == "bowl" else -OVERLAP)
            volume = np.pi * r**2 if dimension == 2 else 4.0 / 3.0 * np.pi * r**3
            sphere = Sphere(
                center=middle[:dimension] * DX, radius=radius * DX, invert=kind == "bowl"
            )
            return sphere, volume if kind == "bowl" else whole - volume
        case _:
            half, out = rng.uniform(2.0, 3.0, dimension), kind != "box"
            place = Placement(rotation=turned(rng, dimension), translation=middle * DX)
            volume = float(np.prod(2.0 * (half + (OVERLAP if out else -OVERLAP))))
            return Box(
                lower=-half * DX, upper=half * DX, placement=place, invert=out
            ), volume if out else whole - volume


def distance(solid: Geometry, points: np.ndarray) -> np.ndarray:
    """Return the distance of points [m] to a solid [cells]."""
    found = wp.empty(len(points), dtype=wp.float32, device="cpu")
    solid.signed_distance(wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu"), found)
    return found.numpy() / DX


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_a_surface_ends_at_the_true_wall(kind, dimension, seed):
    """Surface up to the true wall.

    Without the fit boxes miss by up to 0.5 cells at their edges, and bowls and planes by 0.1 to 0.2
    at the domain's sides.
    """
    solid, volume = some_solid(kind, seed, dimension)
    grid = StaggeredGrid((COUNT, COUNT, COUNT if dimension == 3 else 1), DX, dimension)
    cut = CutCells(
        grid, [PlacedSolid(geometry=solid, separating=False, name="solid")], wall_separating=False
    )
    x = np.concatenate([lattice(grid, 2, 0.25, seed, plane) for plane in range(grid.counts[2])])
    particles = wp.array(
        x[distance(solid, x) > 1e-3].astype(np.float32), dtype=wp.vec3, device="cpu"
    )
    mesh = SurfaceMesh(
        grid, per_axis=2, obstacles=SurfaceObstacles(cut.base, cut.distance, False, lambda: [solid])
    ).find(particles)
    points, corners = mesh.points.numpy().astype(np.float64), mesh.corners.numpy()
    assert_closed(corners)
    rng = np.random.default_rng(seed)
    inside = [
        np.einsum("mk,mki->mi", rng.dirichlet(np.ones(dimension), len(corners)), points[corners])
        for _ in range(3)
    ]
    samples = np.concatenate([points, *inside])
    size = COUNT * DX
    side = np.minimum(samples, size - samples)[:, :dimension].min(axis=1) / DX
    gap = distance(solid, samples)
    assert np.minimum(gap, side).max() < 0.01, "air between the surface and a wall"
    assert gap.min() > -2.5 * OVERLAP, "the surface reaches farther into the solid than it is to"
    assert side.min() > -1e-4
    on_solid = side > 0.3
    assert on_solid.sum() > 10
    assert np.median(gap[on_solid]) == pytest.approx(-OVERLAP, abs=0.01)
    if volume is not None:
        # Facets of edge e within a ball lie e^2 / (8 R) inside of it.
        facets = 0.015 if kind in ("ball", "bowl") else 0.005
        assert enclosed(points / DX, corners) == pytest.approx(volume, rel=facets)


def test_a_boundary_has_the_shapes_where_its_solids_are():
    grid = StaggeredGrid((COUNT, COUNT, 1), DX, 2)
    ball = Sphere(center=[0.3, 0.3], radius=0.1)
    still, moving = (
        PlacedSolid(geometry=ball, separating=False, name="ball", motion=motion)
        for motion in (None, Translation(velocity=[0.1, 0.0, 0.0]))
    )
    boundary = CutBoundary(grid, CutCells(grid, [still, moving], wall_separating=False))
    center = np.array([[0.3, 0.3, 0.0]])
    assert [distance(shape, center)[0] for shape in boundary.shapes()] == pytest.approx(
        [-2.0, -2.0], abs=1e-4
    )
    boundary.place(0.5)
    assert [distance(shape, center)[0] for shape in boundary.shapes()] == pytest.approx(
        [-2.0, -1.0], abs=1e-4
    )


def test_no_point_leaves_the_domain_where_a_solid_ends_at_its_corner():
    """Points inside the domain where a solid ends at its corner.

    Points on a side move along it to the wall, which here lies beyond the side's end.
    """
    normal = np.array([-0.476027, 0.879431, 0.0])
    solid = Plane(point=0.0917 * DX * normal, normal=normal)
    grid = StaggeredGrid((COUNT, COUNT, 1), DX, 2)
    cut = CutCells(
        grid, [PlacedSolid(geometry=solid, separating=False, name="solid")], wall_separating=False
    )
    x = lattice(grid, 2, 0.25, 9300, 0)
    particles = wp.array(
        x[distance(solid, x) > 1e-3].astype(np.float32), dtype=wp.vec3, device="cpu"
    )
    mesh = SurfaceMesh(
        grid, per_axis=2, obstacles=SurfaceObstacles(cut.base, cut.distance, False, lambda: [solid])
    ).find(particles)
    points = mesh.points.numpy()
    assert points.min() >= 0.0
    assert distance(solid, points).min() > -0.1
