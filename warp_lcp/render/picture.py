"""Pictures of a run's frames, drawn by pyvista without a screen.

They show domain, solids and material. Needs the extra `render`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_lcp.grid.motion import Pose
from warp_lcp.render.actors import (
    SHADES,
    WHITEWATER,
    WHITEWATER_RADIUS,
    Actors,
    MeshStyle,
    StyledMesh,
    body_meshes,
    shaded,
    surface_meshes,
)
from warp_lcp.render.grains import grains
from warp_lcp.render.image_content import WITH_PARTICLES, WITH_SURFACE, Color, VisiblePart
from warp_lcp.render.recording import RecordedFrame, Recording
from warp_lcp.render.solid_meshes import (
    FlatSolids,
    RoomSolids,
    SolidDrawer,
    apart,
    prescribed_solids,
)
from warp_lcp.render.sunlight import LIGHT, SHADE, Sunlight, scattered
from warp_lcp.scene.camera import Viewpoint, viewpoint

if TYPE_CHECKING:
    import pyvista

# Samples per pixel and direction: images are drawn larger and averaged down, since splats have no
# other antialiasing.
SAMPLES = 2
# Distance of walls in front of 2-D particles, relative to the longest side, and to a disc's radius:
# discs face the camera.
FRONT, TILT = 1e-3, 0.3
SMALL = 0.25  # radius of particles inside a surface, relative to their spacing
# Background of 3-D domains at the bottom, fading into white, which would hide water.
BACKDROPS = {"water": "#c9d5df", "other": "#e3e2df"}

DISC = """//VTK::Color::Impl
float distance2 = dot(offsetVCVSOutput.xy, offsetVCVSOutput.xy);
if (distance2 > 1.0) discard;
"""
BALL = (
    DISC
    + "ambientColor *= 0.8 + 0.2 * sqrt(1.0 - distance2);\ndiffuseColor *= 0.8 + 0.2 * sqrt(1.0 - "
    "distance2);\n"
)
# Lit from above and in front: the lamp in the coordinates of the default camera.
GRAIN = (
    DISC
    + """vec3 normal = vec3(offsetVCVSOutput.xy, sqrt(1.0 - distance2));
float light = 0.62 + 0.42 * max(dot(normal, vec3(0.0, 0.6, 0.8)), 0.0);
ambientColor *= light;
diffuseColor *= light;
"""
)

SPLATS: MeshStyle = {
    "style": "points_gaussian",
    "emissive": False,
    "render_points_as_spheres": True,
    "lighting": False,
}


class Picture:
    """Plotter of a run's frames, with fixed and changing actors.

    Args:
        recording: frames of the run.
        size: width and height of an image [pixels].
        plotter: a pyvista plotter to draw into; it is shown on a screen, at its own size.
    """

    def __init__(
        self, recording: Recording, size: tuple[int, int], plotter: pyvista.Plotter | None = None
    ) -> None:
        import pyvista

        scene = self.scene = recording.scene
        self.recording = recording
        self.flat = scene.dimension == 2
        share = SMALL if recording.show is VisiblePart.BOTH else 0.6 if self.flat else 0.8
        self.spacing = recording.particle_spacing()
        self.radius = share * self.spacing
        self.grainy = (
            scene.palette == "sand"
            and recording.show is VisiblePart.PARTICLES
            and recording.color in (Color.SPEED, Color.PLAIN)
        )
        self.samples = 1 if plotter else SAMPLES
        self.plotter = plotter or pyvista.Plotter(
            off_screen=True, window_size=[SAMPLES * side for side in size], lighting="none"
        )
        # 0 is three times as fast in software; SAMPLES smooths too.
        self.plotter.render_window.SetMultiSamples(0 if plotter is None else 8)
        water = recording.show in WITH_SURFACE and scene.palette == "water"
        self.plotter.set_background(
            "white" if self.flat else BACKDROPS["water"] if water else BACKDROPS["other"],
            top="white",
        )
        for position, kind, intensity in [
            (LIGHT, "scene light", 0.45),
            (np.array([0.0, 0.0, 1.0]), "headlight", 0.25),
        ]:
            light = pyvista.Light(
                position=tuple(position),
                focal_point=(0, 0, 0),
                light_type=kind,
                intensity=intensity,
            )
            self.plotter.add_light(light)
        view = viewpoint(scene, size[0] / size[1])
        outside = (
            None if plotter or recording.show not in WITH_PARTICLES else self._outside(view, size)
        )
        self._blank = None if outside is None else (outside, self._pixels()[outside])
        self.actors = Actors(self.plotter)
        self.front = max(FRONT * max(scene.domain.size), TILT * self.radius)
        self._place_standing()
        self.bodies_at_first = recording.bodies(recording.numbers[0])
        camera = self.plotter.camera
        camera.position, camera.focal_point, camera.up = (
            tuple(view.position),
            tuple(view.focus),
            tuple(view.up),
        )
        camera.view_angle = view.angle

    def place(self, frame: RecordedFrame) -> None:
        """Replace the actors of the last frame with those of a frame."""
        moving = [(solid, motion.pose(frame.time)) for solid, motion in self._moving]
        size, width = self.scene.domain.size, self.samples
        solids = self._solids.meshes(moving)
        self.actors.exchange("moving", solids)
        visible_surface = frame.surface
        if visible_surface is not None and self._wet:
            poses = [
                (geometry, motion.pose(frame.time) if motion else Pose.identity())
                for geometry, motion in self._wet
            ]
            visible_surface = apart(visible_surface, poses, self.scene.spacing)
        surface = (
            []
            if visible_surface is None
            else surface_meshes(visible_surface, self.scene.palette, size, width)
        )
        self.actors.exchange("surface", surface)
        bodies = body_meshes(frame.bodies, self.bodies_at_first, 1.5 * width, 2.0 * self.front)
        self.actors.exchange("bodies", bodies)
        sun = None
        if not self.flat:
            surface_points = [mesh.points for mesh, _ in surface]
            sun = Sunlight(
                [self._shading, frame.points, *surface_points, self._casters([*solids, *bodies])],
                self.spacing,
            )
            self.actors.exchange("floor", [sun.floor(size)])
        particles, radius = self._particles(frame, sun)
        for actor in self.actors.exchange("particles", particles):
            actor.mapper.SetSplatShaderCode(DISC if self.flat else GRAIN if self.grainy else BALL)
            actor.mapper.scale_factor = radius
        for actor in self.actors.exchange("whitewater", self._whitewater(frame)):
            actor.mapper.SetSplatShaderCode(DISC)
            actor.mapper.scale_factor = WHITEWATER_RADIUS * self.scene.spacing

    def draw(self, frame: RecordedFrame) -> np.ndarray:
        """Return an image of a frame."""
        from PIL import Image

        self.place(frame)
        self.plotter.renderer.reset_camera_clipping_range()
        pixels = self._pixels()
        # Balls that extend beyond the domain's walls would cover its edges.
        if self._blank is not None:
            outside, background = self._blank
            pixels[outside] = background
        return np.asarray(Image.fromarray(pixels).reduce(SAMPLES))

    def close(self) -> None:
        """Free the window that pyvista draws into."""
        self.plotter.close()

    def _pixels(self) -> np.ndarray:
        """Render, and return the pixels, with SAMPLES per pixel along each axis."""
        self.plotter.render()
        return np.array(self.plotter.screenshot(return_img=True))

    def _outside(self, view: Viewpoint, size: tuple[int, int]) -> np.ndarray | None:
        """Return the pixels outside the outline of a 3-D domain.

        None if the scene is 2-D, or a corner is behind the camera.
        """
        from scipy.spatial import ConvexHull

        if self.flat:
            return None
        corners = np.stack(
            np.meshgrid(*((0.0, side) for side in self.scene.domain.size)), axis=-1
        ).reshape(-1, 3)
        x, y, depth = ((corners - view.position) @ view.axes.T).T
        if depth.min() <= 0.0:
            return None
        width, height = (self.samples * side for side in size)
        focal = 0.5 * height / math.tan(math.radians(view.angle / 2.0))  # focal length [pixels]
        hull = ConvexHull(
            np.stack([0.5 * width + focal * x / depth, 0.5 * height - focal * y / depth], axis=-1)
        )
        column, row = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
        # The lines of the box are drawn on its outline.
        beyond = [a * column + b * row + c > self.samples for a, b, c in hull.equations]
        return np.any(beyond, axis=0)

    def _place_standing(self) -> None:
        """Draw the domain and the solids at rest, and prepare the moving ones."""
        solids = prescribed_solids(self.scene)
        sides, width = self.scene.domain.size, 2 * self.samples
        # A drawer gets back what it has prepared.
        drawer: SolidDrawer[Any] = (
            FlatSolids(sides, width, self.front) if self.flat else RoomSolids(sides, width)
        )
        self._solids = drawer
        standing = [
            (self._solids.prepared(solid), Pose.identity()) for solid in solids if not solid.motion
        ]
        meshes = self._solids.meshes(standing)
        self.actors.exchange("standing", [*self._solids.domain(), *meshes])
        self._shading = np.zeros((0, 3)) if self.flat else self._casters(meshes)
        hidden = (
            []
            if self.flat or self.scene.palette != "water"
            else [solid for solid in solids if not solid.invert]
        )
        self._wet = [
            (solid.to_geometry(Path(), 3), solid.motion.to_motion(3) if solid.motion else None)
            for solid in hidden
        ]
        self._moving = [
            (self._solids.prepared(solid), solid.motion.to_motion(self.scene.dimension))
            for solid in solids
            if solid.motion
        ]

    def _casters(self, meshes: list[StyledMesh]) -> np.ndarray:
        """Return points [m] on objects that cast shadows.

        Lines, and containers, which are transparent, cast none.
        """
        return np.concatenate(
            [
                np.zeros((0, 3)),
                *(
                    scattered(mesh, self.spacing)
                    for mesh, looks in meshes
                    if not {"opacity", "line_width"} & looks.keys()
                ),
            ]
        )

    def _particles(
        self, frame: RecordedFrame, sun: Sunlight | None
    ) -> tuple[list[StyledMesh], float]:
        """Return particles as discs, balls or grains, shaded, and their radius [m]."""
        import pyvista

        points, radius = frame.points, self.radius
        if not len(points):
            return [], radius
        colors = self.recording.scale.colors(frame.values)
        if sun is not None:
            colors, outer = shaded(points, colors, self.scene.spacing, self.scene.palette)
            points, colors = points[outer], colors[outer]
            if self.grainy:
                colors *= 1.0 - SHADE * SHADES[self.scene.palette] * (
                    1.0 - sun.reaches(points)[:, None]
                )
        if self.grainy:
            points, colors, radius = grains(points, colors, self.spacing, self.scene.domain.size)
        return [
            (pyvista.PolyData(points), {"scalars": colors.astype(np.uint8), "rgb": True, **SPLATS})
        ], radius

    def _whitewater(self, frame: RecordedFrame) -> list[StyledMesh]:
        """Return spray, foam and bubbles as discs, in 2-D in front of the liquid."""
        import pyvista
        from matplotlib.colors import to_rgb

        if frame.whitewater is None or not len(frame.whitewater.points):
            return []
        points = np.array(frame.whitewater.points, dtype=np.float64)
        if self.flat:
            points[:, 2] = 0.5 * self.front
        palette = (255.0 * np.array([to_rgb(color) for color in WHITEWATER])).astype(np.uint8)
        kinds = np.clip(frame.whitewater.fields["kind"].astype(int), 0, len(palette) - 1)
        return [(pyvista.PolyData(points), {"scalars": palette[kinds], "rgb": True, **SPLATS})]
