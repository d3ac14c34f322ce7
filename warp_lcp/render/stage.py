"""The stage of a run's images: domain, solids and particles, drawn by pyvista without a screen. Needs the extra `render`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from warp_lcp.render.cast import Cast
from warp_lcp.render.outline_fill import FILLS, fill_outline
from warp_lcp.render.recording import Frame, Recording, Show
from warp_lcp.render.scenery import FlatScenery, RoomScenery
from warp_lcp.render.water import draw_water
from warp_lcp.scene.camera import THREE_QUARTERS, viewpoint
from warp_lcp.simulation import Surface

if TYPE_CHECKING:
    from PIL.Image import Image

SAMPLES = 2  # per pixel and direction: images are drawn larger and averaged down, since splats have no other anti-aliasing
SMALL = 0.25  # radius of particles that a surface is shown around, over their spacing
BACKDROP = "#c9d5df"  # at the bottom, fading into white, below water, which white behind it would hide
SHADING_CELLS = 4e6  # of the density that shades a liquid, to bound its memory

LIGHT = np.array([0.25, 0.9, 0.45]) / np.linalg.norm([0.25, 0.9, 0.45])  # from the domain to the light
SHADES = {"water": np.array([1.4, 1.0, 0.7]), "sand": np.array([1.1, 1.3, 1.5])}  # shadows of water are blue, of sand brown
SHEENS = {"water": 0.35, "sand": 0.0}  # how bright the lamp's mirror image is: sand has none
GLINT = (LIGHT + THREE_QUARTERS) / np.linalg.norm(LIGHT + THREE_QUARTERS)  # the normal that mirrors the light into the camera

DISC = """//VTK::Color::Impl
float distance2 = dot(offsetVCVSOutput.xy, offsetVCVSOutput.xy);
if (distance2 > 1.0) discard;
"""
BALL = DISC + "ambientColor *= 0.8 + 0.2 * sqrt(1.0 - distance2);\ndiffuseColor *= 0.8 + 0.2 * sqrt(1.0 - distance2);\n"


class Stage:
    """A window without a screen in which domain and solids stand or move, and particles, surfaces and bodies come and go.

    Args:
        recording: of the run.
        size: width and height of an image [pixels].
        plotter: pyvista's, to draw into instead; it is shown on a screen, at its own size.
    """

    def __init__(self, recording: Recording, size: tuple[int, int], plotter: Any = None) -> None:
        """Draw what stands."""
        import pyvista

        scene = self.scene = recording.scene
        self.recording = recording
        self.flat = scene.dimension == 2
        self.on_screen = plotter is not None
        self.scale = recording.scale
        share = SMALL if recording.show is Show.BOTH else 0.6 if self.flat else 0.8
        self.radius = share * recording.particle_spacing()
        samples = 1 if self.on_screen else SAMPLES
        self.plotter = plotter or pyvista.Plotter(off_screen=True, window_size=[samples * side for side in size], lighting="none")
        self.plotter.render_window.SetMultiSamples(8 if self.on_screen else 0)  # 0 is three times as fast in software; SAMPLES smooths too
        backdrop = recording.show is not Show.PARTICLES and scene.palette == "water" and not self.flat
        self.plotter.set_background(BACKDROP if backdrop else "white", top="white")
        for position, kind, intensity in [(LIGHT, "scene light", 0.45), (np.array([0.0, 0.0, 1.0]), "headlight", 0.25)]:
            light = pyvista.Light(position=tuple(position), focal_point=(0, 0, 0), light_type=kind, intensity=intensity)
            self.plotter.add_light(light)
        self.scenery = (FlatScenery if self.flat else RoomScenery)(self.plotter, scene, 2 * samples)
        at_first = recording.bodies(recording.numbers[0])
        behind = -2e-3 * max(scene.domain.size)  # of solids that are drawn a little behind the particles
        self.cast = Cast(self.plotter, flat=self.flat, line_width=1.5 * samples, behind=behind, at_first=at_first)
        self.view = viewpoint(scene, size[0] / size[1])
        camera = self.plotter.camera
        camera.position, camera.focal_point, camera.up = tuple(self.view.position), tuple(self.view.focus), tuple(self.view.up)
        camera.view_angle = self.view.angle

    def place(self, frame: Frame) -> None:
        """Put on the stage what is there in a frame, except for water, which `draw` adds."""
        self.scenery.place(frame.time)
        self._place_particles(frame)
        self.cast.place_bodies(frame.bodies)
        if frame.surface is not None and (self.on_screen or (self.scene.palette == "sand" and not self.flat)):
            self.cast.place_surface(frame.surface, self.scene.palette)

    def draw(self, frame: Frame) -> Image:
        """Return an image of a frame."""
        from PIL import Image

        self.place(frame)
        self.plotter.renderer.reset_camera_clipping_range()
        self.plotter.render()
        pixels = np.asarray(self.plotter.screenshot(return_img=True))
        if frame.surface is not None and (self.flat or self.scene.palette == "water"):
            depth = -self.plotter.get_image_depth(fill_value=-np.inf, reset_camera_clipping_range=False)
            pixels = self._with_surface(frame.surface, pixels, depth)
        return Image.fromarray(pixels).reduce(SAMPLES)

    def close(self) -> None:
        """Free the window."""
        self.plotter.close()

    def _place_particles(self, frame: Frame) -> None:
        """Draw particles as discs or balls, lit as the surface of the material that they make up."""
        import pyvista

        self.plotter.remove_actor("particles", render=False)
        if not len(frame.points):
            return
        cloud = pyvista.PolyData(frame.points)
        colors = self.scale.colors(frame.values)
        lit = colors if self.flat else shaded(frame.points, colors, self.scene.spacing, self.scene.palette)
        cloud["color"] = lit.astype(np.uint8)
        actor = self.plotter.add_mesh(
            cloud, name="particles", scalars="color", rgb=True, style="points_gaussian", emissive=False,
            render_points_as_spheres=True, lighting=False, reset_camera=False, render=False,
        )  # fmt: skip
        actor.mapper.SetSplatShaderCode(DISC if self.flat else BALL)
        actor.mapper.scale_factor = self.radius

    def _with_surface(self, surface: Surface, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the image with the surface drawn over it; depth is inf where there is nothing [m], shape (height, width)."""
        if self.flat:
            return fill_outline(surface, pixels, depth, self.view, FILLS[self.scene.palette], self.scene.domain.size)
        return draw_water(surface, pixels, depth, self.view, size=max(self.scene.domain.size), light=LIGHT)


def shaded(points: np.ndarray, colors: np.ndarray, spacing: float, palette: str) -> np.ndarray:
    """Light particles as the smooth surface of the liquid that they make up, whose normals point down the gradient of their density.

    Particles inside the liquid, and single drops, keep their color.

    Args:
        points: [m], shape (n, 3).
        colors: 0 to 255, shape (n, 3).
        spacing: over which the density is averaged [m].
        palette: of the material, a key of SHADES.

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
    glint = SHEENS[palette] * np.maximum(normal @ GLINT, 0.0)[:, None] ** 40
    lit = np.clip(colors * (1.0 - flatness * SHADES[palette] * (1.0 - light)), 0.0, 255.0)
    return cast(np.ndarray, lit + flatness * glint * (255.0 - lit))
