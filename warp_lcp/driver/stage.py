"""The stage of a run's images: domain, solids and particles, drawn by pyvista without a screen. Needs the extra `render`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from warp_lcp.driver.scene import Scene
from warp_lcp.driver.scenery import FlatScenery, RoomScenery

if TYPE_CHECKING:
    from PIL.Image import Image

SAMPLES = 2  # per pixel and direction: images are drawn larger and averaged down, since splats have no other anti-aliasing
SHADING_CELLS = 4e6  # of the density that shades a liquid, to bound its memory

VIEW_ANGLE = 25.0  # degrees, over the height of an image
MARGIN = 1.04
THREE_QUARTERS = np.array([0.55, 0.5, 1.0]) / np.linalg.norm([0.55, 0.5, 1.0])  # from the domain to the camera
LIGHT = np.array([0.25, 0.9, 0.45]) / np.linalg.norm([0.25, 0.9, 0.45])  # from the domain to the light
SHADES = {"water": np.array([1.4, 1.0, 0.7]), "sand": np.array([0.9, 1.1, 1.3])}  # shadows of water are blue, of sand brown
GLINT = (LIGHT + THREE_QUARTERS) / np.linalg.norm(LIGHT + THREE_QUARTERS)  # the normal that mirrors the light into the camera

DISC = """//VTK::Color::Impl
float distance2 = dot(offsetVCVSOutput.xy, offsetVCVSOutput.xy);
if (distance2 > 1.0) discard;
"""
BALL = DISC + "ambientColor *= 0.8 + 0.2 * sqrt(1.0 - distance2);\ndiffuseColor *= 0.8 + 0.2 * sqrt(1.0 - distance2);\n"


class Stage:
    """A window without a screen in which domain and solids stand or move, and particles come and go.

    Args:
        scene: of the run.
        size: width and height of an image [pixels].
        particle_spacing: of neighbors [m]; discs and balls overlap a little.
    """

    def __init__(self, scene: Scene, size: tuple[int, int], particle_spacing: float) -> None:
        """Draw what stands."""
        import pyvista

        self.scene = scene
        self.flat = scene.dimension == 2
        self.size = np.array([*scene.domain.size, 0.0][:3])
        self.radius = (0.6 if self.flat else 0.8) * particle_spacing
        self.plotter = pyvista.Plotter(off_screen=True, window_size=[SAMPLES * side for side in size], lighting="none")
        self.plotter.render_window.SetMultiSamples(0)  # three times as fast in software, and SAMPLES smooths edges already
        self.plotter.set_background("white")
        for position, kind, intensity in [(LIGHT, "scene light", 0.45), (np.array([0.0, 0.0, 1.0]), "headlight", 0.25)]:
            light = pyvista.Light(position=tuple(position), focal_point=(0, 0, 0), light_type=kind, intensity=intensity)
            self.plotter.add_light(light)
        self.scenery = FlatScenery(self.plotter, scene, 2 * SAMPLES) if self.flat else RoomScenery(self.plotter, scene, 2 * SAMPLES)
        self._place_camera(size[0] / size[1])

    def draw(self, points: np.ndarray, colors: np.ndarray, time: float) -> Image:
        """Return an image of particles among the solids.

        Args:
            points: [m], shape (n, 3).
            colors: of the particles in plain light, red, green and blue from 0 to 255, shape (n, 3).
            time: that solids with a motion are drawn at [s].
        """
        import pyvista
        from PIL import Image

        self.scenery.place(time)
        self.plotter.remove_actor("particles", render=False)
        if len(points):
            cloud = pyvista.PolyData(points)
            lit = colors if self.flat else shaded(points, colors, self.scene.spacing, SHADES[self.scene.palette])
            cloud["color"] = lit.astype(np.uint8)
            actor = self.plotter.add_mesh(
                cloud, name="particles", scalars="color", rgb=True, style="points_gaussian", emissive=False,
                render_points_as_spheres=True, lighting=False, reset_camera=False, render=False,
            )  # fmt: skip
            actor.mapper.SetSplatShaderCode(DISC if self.flat else BALL)
            actor.mapper.scale_factor = self.radius
        self.plotter.renderer.reset_camera_clipping_range()
        self.plotter.render()
        return Image.fromarray(np.asarray(self.plotter.screenshot(return_img=True))).reduce(SAMPLES)

    def close(self) -> None:
        """Free the window."""
        self.plotter.close()

    def _place_camera(self, aspect: float) -> None:
        """Look at the domain's middle from as near as shows all of it."""
        toward = np.array([0.0, 0.0, 1.0]) if self.flat else THREE_QUARTERS
        right = np.cross([0.0, 1.0, 0.0], toward)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(toward, right), toward])
        corners = np.stack(np.meshgrid(*zip(np.zeros(3), self.size, strict=True)), axis=-1).reshape(-1, 3) @ axes.T
        focus = corners.mean(axis=0)
        slope = math.tan(math.radians(VIEW_ANGLE / 2)) / MARGIN
        for _ in range(5):  # what is near looks larger, so the middle of the image is not that of the domain
            x, y, z = (corners - focus).T
            distance = max((z + np.abs(x) / (slope * aspect)).max(), (z + np.abs(y) / slope).max())
            seen = np.stack([x, y]) / (distance - z)
            focus[:2] += 0.5 * (seen.min(axis=1) + seen.max(axis=1)) * distance
        camera = self.plotter.camera
        camera.focal_point = tuple(focus @ axes)
        camera.position = tuple(focus @ axes + distance * toward)
        camera.up = (0.0, 1.0, 0.0)
        camera.view_angle = VIEW_ANGLE


def shaded(points: np.ndarray, colors: np.ndarray, spacing: float, shade: np.ndarray) -> np.ndarray:
    """Light particles as the smooth surface of the liquid that they make up, whose normals point down the gradient of their density.

    Particles inside the liquid, and single drops, keep their color.

    Args:
        points: [m], shape (n, 3).
        colors: 0 to 255, shape (n, 3).
        spacing: over which the density is averaged [m].
        shade: how much of red, green and blue the dark takes away.

    Returns:
        Colors as `colors`.
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    spacing = max(spacing, (float(np.prod(extent + 6 * spacing)) / SHADING_CELLS) ** (1 / 3))
    at = (points - low) / spacing + 3.25  # a lattice of two particles a cell then lies well inside the bins
    density, _ = np.histogramdd(at, bins=[range(math.ceil(side) + 1) for side in at.max(axis=0) + 3.0])
    density = gaussian_filter(np.minimum(density, 8.0), 1.2)
    slopes = np.gradient(density)
    slope = np.stack([map_coordinates(-component, at.T - 0.5, order=1) for component in slopes], axis=-1)
    steepness = np.linalg.norm(slope, axis=1, keepdims=True)
    normal = slope / np.maximum(steepness, 1e-9)
    flatness = np.clip(steepness / 0.8, 0.0, 1.0)  # 0 inside and for drops, 1 at a surface
    facing = (normal @ LIGHT)[:, None]
    light = 0.72 + 0.22 * facing + 0.14 * np.maximum(facing, 0.0)
    glint = 0.35 * np.maximum(normal @ GLINT, 0.0)[:, None] ** 40
    lit = np.clip(colors * (1.0 - flatness * shade * (1.0 - light)), 0.0, 255.0)
    return cast(np.ndarray, lit + flatness * glint * (255.0 - lit))
