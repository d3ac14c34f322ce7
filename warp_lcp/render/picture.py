"""Pictures of a run's frames: domain, solids and material, drawn by pyvista without a screen. Needs the extra `render`."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.grid.motion import Pose
from warp_lcp.render.actors import LIGHT, Actors, Drawn, body_meshes, shaded, surface_meshes
from warp_lcp.render.recording import Frame, Recording, Show
from warp_lcp.render.solid_meshes import FlatSolids, RoomSolids, prescribed_solids
from warp_lcp.scene.camera import viewpoint

SAMPLES = 2  # per pixel and direction: images are drawn larger and averaged down, since splats have no other anti-aliasing
SMALL = 0.25  # radius of particles that a surface is shown around, over their spacing
BACKDROP = "#c9d5df"  # at the bottom, fading into white, below water, which white behind it would hide

DISC = """//VTK::Color::Impl
float distance2 = dot(offsetVCVSOutput.xy, offsetVCVSOutput.xy);
if (distance2 > 1.0) discard;
"""
BALL = DISC + "ambientColor *= 0.8 + 0.2 * sqrt(1.0 - distance2);\ndiffuseColor *= 0.8 + 0.2 * sqrt(1.0 - distance2);\n"


class Picture:
    """A plotter on which domain and solids stand or move, and particles, surfaces and bodies come and go.

    Args:
        recording: of the run.
        size: width and height of an image [pixels].
        plotter: pyvista's, to draw into instead; it is shown on a screen, at its own size.
    """

    def __init__(self, recording: Recording, size: tuple[int, int], plotter: Any = None) -> None:
        import pyvista

        scene = self.scene = recording.scene
        self.recording = recording
        self.flat = scene.dimension == 2
        share = SMALL if recording.show is Show.BOTH else 0.6 if self.flat else 0.8
        self.radius = share * recording.particle_spacing()
        self.samples = 1 if plotter else SAMPLES
        self.plotter = plotter or pyvista.Plotter(off_screen=True, window_size=[SAMPLES * side for side in size], lighting="none")
        self.plotter.render_window.SetMultiSamples(0 if plotter is None else 8)  # 0 is three times as fast in software; SAMPLES smooths too
        backdrop = recording.show is not Show.PARTICLES and scene.palette == "water" and not self.flat
        self.plotter.set_background(BACKDROP if backdrop else "white", top="white")
        for position, kind, intensity in [(LIGHT, "scene light", 0.45), (np.array([0.0, 0.0, 1.0]), "headlight", 0.25)]:
            light = pyvista.Light(position=tuple(position), focal_point=(0, 0, 0), light_type=kind, intensity=intensity)
            self.plotter.add_light(light)
        self.actors = Actors(self.plotter)
        self._place_standing()
        self.bodies_at_first = recording.bodies(recording.numbers[0])
        view = viewpoint(scene, size[0] / size[1])
        camera = self.plotter.camera
        camera.position, camera.focal_point, camera.up = tuple(view.position), tuple(view.focus), tuple(view.up)
        camera.view_angle = view.angle

    def place(self, frame: Frame) -> None:
        """Exchange what is not there any more for what is there in a frame."""
        moving = [(solid, motion.pose(frame.time)) for solid, motion in self._moving]
        self.actors.exchange("moving", self._solids.meshes(moving))
        for actor in self.actors.exchange("particles", self._particles(frame)):
            actor.mapper.SetSplatShaderCode(DISC if self.flat else BALL)
            actor.mapper.scale_factor = self.radius
        size, width = self.scene.domain.size, self.samples
        surface = [] if frame.surface is None else surface_meshes(frame.surface, self.scene.palette, size, width)
        self.actors.exchange("surface", surface)
        self.actors.exchange("bodies", body_meshes(frame.bodies, self.bodies_at_first, 1.5 * width))

    def draw(self, frame: Frame) -> np.ndarray:
        """Return an image of a frame."""
        from PIL import Image

        self.place(frame)
        self.plotter.renderer.reset_camera_clipping_range()
        self.plotter.render()
        return np.asarray(Image.fromarray(self.plotter.screenshot(return_img=True)).reduce(SAMPLES))

    def close(self) -> None:
        """Free the window that pyvista draws into."""
        self.plotter.close()

    def _place_standing(self) -> None:
        """Draw the domain and the solids that stand, and prepare those that move."""
        solids = prescribed_solids(self.scene)
        kind: Any = FlatSolids if self.flat else RoomSolids
        self._solids = kind(self.scene.domain.size, 2 * self.samples)
        standing = [(self._solids.prepared(solid), Pose.identity()) for solid in solids if not solid.motion]
        self.actors.exchange("standing", [*self._solids.domain(), *self._solids.meshes(standing)])
        self._moving = [(self._solids.prepared(solid), solid.motion.to_motion(self.scene.dimension)) for solid in solids if solid.motion]

    def _particles(self, frame: Frame) -> list[Drawn]:
        """Return particles as discs or balls, lit as the surface of the material that they make up."""
        import pyvista

        if not len(frame.points):
            return []
        colors = self.recording.scale.colors(frame.values)
        lit = colors if self.flat else shaded(frame.points, colors, self.scene.spacing, self.scene.palette)
        looks = {"style": "points_gaussian", "emissive": False, "render_points_as_spheres": True, "lighting": False}
        return [(pyvista.PolyData(frame.points), {"scalars": lit.astype(np.uint8), "rgb": True, **looks})]
