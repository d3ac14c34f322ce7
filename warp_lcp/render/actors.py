"""Actors of a run's images: particles, surfaces and rigid bodies.

Needs the extra `render`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias, TypedDict

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from warp_lcp.render.sunlight import LIGHT
from warp_lcp.scene.camera import THREE_QUARTERS
from warp_lcp.simulation import Surface

if TYPE_CHECKING:
    import pyvista
    from matplotlib.colors import LinearSegmentedColormap

BODY_COLORS = [
    "#e07a3f",
    "#d9b23c",
    "#7fa650",
    "#b9586b",
    "#8d6fb0",
    "#4d9a94",
    "#c98f63",
    "#6f7f95",
]
BODY_EDGE = "#4a3b33"
LIGHTER = 0.5  # fraction of the way to white, for every other octant of a ball
BOX_POINTS = 8
ROUND = 1e-3  # largest relative difference of the distances from the center of a round body
SURFACES: dict[str, MeshStyle] = {  # in 3-D, by `Scene.palette`
    "water": {
        "color": "#4aa9ee",
        "opacity": 0.5,
        "specular": 0.8,
        "specular_power": 30.0,
        "ambient": 0.3,
        "diffuse": 1.0,
    },
    "sand": {"color": "#c9a15f", "specular": 0.0, "ambient": 0.4},
}
# In 2-D, at the domain's bottom and at its top.
FILLS = {"water": ["#1254a2", "#78c4ee"], "sand": ["#aa7c46", "#deb87a"]}
OUTLINES = {"water": "#0c3e80", "sand": "#78522a"}

# Spray, foam and bubbles, and the radius of a particle [cells].
WHITEWATER, WHITEWATER_RADIUS = ["#ffffff", "#ffffff", "#dcefff"], 0.13

# Shadows are blue for water, brown for sand.
SHADES = {"water": np.array([1.4, 1.0, 0.7]), "sand": np.array([1.1, 1.3, 1.5])}
SHEENS = {"water": 0.35, "sand": 0.0}  # brightness of the lamp's specular reflection; 0 for sand
# The normal that reflects the light into the camera.
GLINT = (LIGHT + THREE_QUARTERS) / np.linalg.norm(LIGHT + THREE_QUARTERS)
# Slope and density, in particles per cell: flatter and denser is deeper inside than two cells.
HIDDEN_SLOPE, HIDDEN_DENSITY = 0.6, 6.0
SHADING_CELLS = 4e6  # cells of the density that shades a liquid, to limit its memory

# Distance from a side of the domain up to which a point is on it, relative to the longest side.
FLUSH = 1e-5

StyledMesh: TypeAlias = "tuple[pyvista.DataSet, MeshStyle]"  # a mesh, and how it is drawn


class MeshStyle(TypedDict, total=False):
    """Arguments of pyvista's `Plotter.add_mesh` that the images use."""

    color: str
    scalars: str | np.ndarray
    rgb: bool
    cmap: LinearSegmentedColormap | list[str]
    n_colors: int
    clim: Sequence[float] | np.ndarray
    opacity: float
    lighting: bool
    ambient: float
    diffuse: float
    specular: float
    specular_power: float
    smooth_shading: bool
    split_sharp_edges: bool
    culling: str
    style: str
    emissive: bool
    render_points_as_spheres: bool
    line_width: float


class Actors:
    """Actors of a plotter, in groups that are replaced as a whole."""

    def __init__(self, plotter: pyvista.Plotter) -> None:
        self.plotter = plotter
        self._counts: dict[str, int] = defaultdict(int)

    def exchange(self, group: str, meshes: Sequence[StyledMesh]) -> list[pyvista.Actor]:
        """Replace the meshes of a group; return the actors of those with points."""
        for number in range(self._counts[group]):
            self.plotter.remove_actor(f"{group} {number}", render=False)
        visible = [(mesh, looks) for mesh, looks in meshes if mesh.n_points]
        self._counts[group] = len(visible)
        return [
            self.plotter.add_mesh(
                mesh,
                name=f"{group} {number}",
                reset_camera=False,
                render=False,
                show_scalar_bar=False,
                **looks,
            )
            for number, (mesh, looks) in enumerate(visible)
        ]


def surface_meshes(
    surface: Surface, palette: str, size: Sequence[float], line_width: float
) -> list[StyledMesh]:
    """Return the surface of a material, separated by the domain's sides.

    In 2-D it consists of the inside, deeper in color toward the bottom, and the outline, behind the
    solids.

    Args:
        surface: triangles, or closed chains of segments.
        palette: palette of the material.
        size: size of the domain [m].
        line_width: width of the outline [pixels].
    """
    if not len(surface.corners):
        return []
    if len(size) == 3:
        ends = np.abs(surface.points - np.stack([np.zeros(3), size])[:, None]) < FLUSH * max(size)
        on_side = ends[:, surface.corners].all(axis=2).transpose(1, 0, 2).reshape(-1, 6)
        side = np.where(on_side.any(axis=1), on_side.argmax(axis=1), 6)
        # Each part has normals of its own, for sharp edges.
        parts = [surface.corners[side == number] for number in np.unique(side)]
        return [
            (poly_data(surface.points, part), {"smooth_shading": True, **SURFACES[palette]})
            for part in parts
        ]
    mesh = poly_data(surface.points, surface.corners)
    from matplotlib.colors import LinearSegmentedColormap

    behind = -2e-3 * max(size)
    outline = mesh.clean()
    inside = outline.triangulate_contours()
    colors = LinearSegmentedColormap.from_list(palette, FILLS[palette])
    depth: MeshStyle = {
        "scalars": inside.points[:, 1],
        "cmap": colors,
        "clim": [0.0, size[1]],
        "lighting": False,
    }
    line: MeshStyle = {"color": OUTLINES[palette], "line_width": line_width, "lighting": False}
    return [
        (inside.translate((0.0, 0.0, behind)), depth),
        (outline.translate((0.0, 0.0, 0.95 * behind)), line),
    ]


def body_meshes(
    bodies: Surface | None, at_first: Surface | None, line_width: float, front: float
) -> list[StyledMesh]:
    """Return rigid bodies at their positions, each in a color of its own.

    Args:
        bodies: surfaces with the field `body`; None without bodies.
        at_first: the bodies in the run's first frame, which defines the octants of balls.
        line_width: width of the outlines of bodies in 2-D [pixels].
        front: distance of bodies in 2-D in front of the particles [m].
    """
    if bodies is None:
        return []
    of_corner = np.asarray(bodies.fields["body"]).ravel()[bodies.corners[:, 0]]
    meshes: list[StyledMesh] = []
    for number, body in enumerate(np.unique(of_corner)):
        color, corners = BODY_COLORS[number % len(BODY_COLORS)], bodies.corners[of_corner == body]
        if corners.shape[1] == 2:
            meshes += _flat_body(bodies.points, corners, color, line_width, front)
        else:
            meshes.append(_solid_body(bodies.points, corners, color, at_first))
    return meshes


def _solid_body(
    points: np.ndarray, corners: np.ndarray, color: str, at_first: Surface | None
) -> StyledMesh:
    """Return a body; a ball has octants of two shades, which show its rotation."""
    from matplotlib.colors import to_hex, to_rgb

    mesh = poly_data(points, corners)
    looks: MeshStyle = {
        "smooth_shading": True,
        "ambient": 0.45,
        "specular": 0.25,
        "specular_power": 30.0,
    }
    if at_first is None or len(at_first.points) != len(points) or not is_round(points, corners):
        return mesh, {"color": color, "split_sharp_edges": True, **looks}
    own = at_first.points[np.unique(corners)]
    # The sign alternates between octants.
    side = np.prod(own - 0.5 * (own.min(axis=0) + own.max(axis=0)), axis=1)
    pale = to_hex(LIGHTER + (1.0 - LIGHTER) * np.array(to_rgb(color)))
    return mesh, {
        "scalars": side,
        "cmap": [color, pale],
        "n_colors": 2,
        "clim": np.abs(side).max() * np.array([-1.0, 1.0]),
        **looks,
    }


def _flat_body(
    points: np.ndarray, corners: np.ndarray, color: str, line_width: float, front: float
) -> list[StyledMesh]:
    """Return inside and outline of a body, in front of particles and walls."""
    outline = poly_data(points, corners).clean()
    inside = outline.triangulate_contours().translate((0.0, 0.0, front))
    if is_round(points, corners):  # a radius, which shows the rotation of the disc
        outline = outline.merge(
            poly_data(
                np.stack([points[corners[:, 0]].mean(axis=0), points[corners[0, 0]]]),
                np.array([[0, 1]]),
            )
        )
    line: MeshStyle = {"color": BODY_EDGE, "line_width": line_width, "lighting": False}
    return [
        (inside, {"color": color, "lighting": False}),
        (outline.translate((0.0, 0.0, 1.2 * front)), line),
    ]


def poly_data(points: np.ndarray, corners: np.ndarray) -> pyvista.PolyData:
    """Return triangles or segments as PolyData, with only the points in use."""
    import pyvista

    used, own = np.unique(corners, return_inverse=True)
    own = own.reshape(corners.shape)
    if corners.shape[1] == 3:
        return pyvista.PolyData.from_regular_faces(points[used], own)
    return pyvista.PolyData(
        points[used], lines=np.column_stack([np.full(len(own), 2), own]).ravel()
    )


def is_round(points: np.ndarray, corners: np.ndarray) -> bool:
    """Return whether a body is a disc or a ball.

    Its points [m], more than those of a box, have one distance from their center.
    """
    own = points[np.unique(corners)]
    distance = np.linalg.norm(own - 0.5 * (own.min(axis=0) + own.max(axis=0)), axis=1)
    return len(own) > BOX_POINTS and bool(np.ptp(distance) < ROUND * distance.max())


def shaded(
    points: np.ndarray, colors: np.ndarray, spacing: float, palette: str
) -> tuple[np.ndarray, np.ndarray]:
    """Shade particles like a smooth surface of the liquid.

    The normals are opposite to the gradient of the particles' density. Particles inside the liquid,
    and single drops, keep their color.

    Args:
        points: [m], shape (n, 3).
        colors: 0 to 255, shape (n, 3).
        spacing: length over which the density is averaged [m].
        palette: palette of the material, a key of SHADES.

    Returns:
        Colors as `colors`, and a mask of the particles that are not hidden deep inside, shape (n,).
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    spacing = max(spacing, (float(np.prod(extent + 6 * spacing)) / SHADING_CELLS) ** (1 / 3))
    # A lattice of two particles per cell then lies well inside the bins.
    at = (points - low) / spacing + 3.25
    density, _ = np.histogramdd(
        at, bins=[range(math.ceil(side) + 1) for side in at.max(axis=0) + 3.0]
    )
    density = gaussian_filter(np.minimum(density, 8.0), 1.2)
    slopes = np.gradient(density)
    slope = np.stack(
        [map_coordinates(-component, at.T - 0.5, order=1) for component in slopes], axis=-1
    )
    steepness = np.linalg.norm(slope, axis=1, keepdims=True)
    normal = slope / np.maximum(steepness, 1e-9)
    flatness = np.clip(steepness / 0.8, 0.0, 1.0)  # 0 inside and for drops, 1 at a surface
    facing = (normal @ LIGHT)[:, None]
    light = 0.72 + 0.22 * facing + 0.14 * np.maximum(facing, 0.0)
    glint = SHEENS[palette] * np.maximum(normal @ GLINT, 0.0)[:, None] ** 40
    lit = np.clip(colors * (1.0 - flatness * SHADES[palette] * (1.0 - light)), 0.0, 255.0)
    outer = (steepness[:, 0] > HIDDEN_SLOPE) | (
        map_coordinates(density, at.T - 0.5, order=1) < HIDDEN_DENSITY
    )
    return lit + flatness * glint * (255.0 - lit), outer
