"""Sections through a run, drawn by Matplotlib alone.

They show cells and their pressure, particles nearby, the outlines of solids and surfaces.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.grid.motion import Pose
from warp_lcp.render.actors import BODY_COLORS, BODY_EDGE, WHITEWATER
from warp_lcp.render.image_content import Color, RenderError
from warp_lcp.render.recording import RecordedFrame, Recording
from warp_lcp.render.solid_meshes import EDGE, nearest_distance, prescribed_solids
from warp_lcp.simulation import Surface

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DOTS_AN_INCH = 100
OUTLINE_POINTS = 400  # sample points of solids along the longest side
CELL, DOT, SOLID, LINE = "#e6eaee", "#1c3f63", "#c3c7cc", "#0c3e80"
SMALLEST_DOT, LARGEST_DOT = 2.0, 5.0  # points


class Section:
    """Picture of the x-y plane: a 2-D run, or a cut through a 3-D one.

    Args:
        recording: frames of the run.
        size: width and height of an image [pixels].
        at: z of the cut [m]. Default: the middle of a 3-D domain.

    Raises:
        RenderError: the cut is not in the domain.
    """

    def __init__(
        self, recording: Recording, size: tuple[int, int], at: float | None = None
    ) -> None:
        """Choose the cut and prepare the solids."""
        self.recording, self.size, self.scene = recording, size, recording.scene
        flat = self.scene.dimension == 2
        if at is not None and flat:
            raise RenderError("--at: is for 3-D runs; this one is 2-D")
        depth = 0.0 if flat else self.scene.domain.size[2]
        self.at = None if flat else depth / 2 if at is None else at
        if self.at is not None and not 0.0 <= self.at <= depth:
            raise RenderError(f"--at {self.at:g}: must be inside the domain, from 0 to {depth:g} m")
        self._solids = []
        for solid in prescribed_solids(self.scene):
            motion = solid.motion.to_motion(self.scene.dimension) if solid.motion else None
            self._solids.append((solid.to_geometry(Path(), self.scene.dimension), motion))

    def draw(self, frame: RecordedFrame) -> np.ndarray:
        """Return a picture of a frame."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        width, height = self.size
        figure = Figure(
            figsize=(width / DOTS_AN_INCH, height / DOTS_AN_INCH),
            dpi=DOTS_AN_INCH,
            layout="constrained",
        )
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        self._draw_cells(axes, frame)
        self._draw_solids(axes, frame.time)
        if frame.surface is not None:
            self._draw_lines(axes, frame.surface, LINE)
        self._draw_particles(axes, frame)
        self._draw_whitewater(axes, frame)
        if frame.bodies is not None:
            self._fill_bodies(axes, frame.bodies)
        camera = self.scene.camera
        seen = [corner.tolist() for corner in self.scene.seen]
        low, high = camera.low or seen[0], camera.high or seen[1]
        axes.set(
            xlim=(low[0], high[0]),
            ylim=(low[1], high[1]),
            aspect="equal",
            xlabel="x [m]",
            ylabel="y [m]",
        )
        if self.at is not None:
            axes.set_title(f"z = {self.at:g} m", fontsize="medium")
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3]

    def close(self) -> None:
        """Do nothing: pictures do not share a figure."""

    def _draw_cells(self, axes: Axes, frame: RecordedFrame) -> None:
        """Fill the cut cells, with the colors of their pressure if requested."""
        from matplotlib.colors import ListedColormap

        if frame.cells is None:
            return
        cells, h = frame.cells, self.scene.spacing
        across, up, through = self.scene.cell_counts
        in_section = (
            np.ones(len(cells.index), dtype=bool)
            if self.at is None
            else cells.index[:, 2] == min(int(self.at / h), through - 1)
        )
        table = np.full((up, across), np.nan)
        column, row = cells.index[in_section, 0], cells.index[in_section, 1]
        colored = self.recording.color is Color.PRESSURE
        table[row, column] = np.asarray(cells.fields["pressure"])[in_section] if colored else 0.0
        scale = self.recording.scale
        looks = (
            {"cmap": scale.mappable.cmap, "norm": scale.mappable.norm}
            if colored
            else {"cmap": ListedColormap([CELL])}
        )
        axes.imshow(
            table,
            origin="lower",
            extent=(0.0, across * h, 0.0, up * h),
            interpolation="nearest",
            zorder=1,
            **looks,
        )

    def _draw_solids(self, axes: Axes, time: float) -> None:
        """Fill the region of negative distance to the nearest solid."""
        if not self._solids:
            return
        x, y = (
            np.linspace(
                0.0, side, max(2, round(OUTLINE_POINTS * side / max(self.scene.domain.size)))
            )
            for side in self.scene.domain.size[:2]
        )
        plane = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), self.at or 0.0)], axis=-1)
        poses = [
            (geometry, motion.pose(time) if motion else Pose.identity())
            for geometry, motion in self._solids
        ]
        nearest = nearest_distance(
            poses, wp.array(plane.reshape(-1, 3), dtype=wp.vec3, device="cpu")
        )
        if nearest.min() < 0.0 < nearest.max():
            level = nearest.reshape(len(y), len(x))
            axes.contourf(x, y, level, levels=[-math.inf, 0.0], colors=[SOLID], zorder=3.5)
            axes.contour(x, y, level, levels=[0.0], colors=[EDGE], linewidths=1.0, zorder=3.5)
        elif nearest.max() <= 0.0:
            axes.set_facecolor(SOLID)

    def _draw_lines(self, axes: Axes, surface: Surface, color: str) -> None:
        """Draw the outline of a surface in the plane."""
        from matplotlib.collections import LineCollection

        axes.add_collection(
            LineCollection(list(self._segments(surface)), colors=color, linewidths=1.5, zorder=4)
        )

    def _fill_bodies(self, axes: Axes, bodies: Surface) -> None:
        """Fill the outlines of the bodies in the plane.

        Triangles from the origin to each segment wind around points inside.
        """
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        ends = self._segments(bodies)
        origin = np.zeros((len(ends), 1, 2))
        triangles = np.concatenate([origin, ends, origin], axis=1).reshape(-1, 2)
        codes = np.tile([Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY], len(ends))
        axes.add_patch(
            PathPatch(Path(triangles, codes), facecolor=BODY_COLORS[0], linewidth=0.0, zorder=5)
        )
        self._draw_lines(axes, bodies, BODY_EDGE)

    def _segments(self, surface: Surface) -> np.ndarray:
        """Return the segments of a surface in the plane [m], shape (m, 2, 2)."""
        ends = surface.points[surface.corners]
        return ends[..., :2] if self.at is None else cut(ends, self.at)

    def _draw_particles(self, axes: Axes, frame: RecordedFrame) -> None:
        """Draw the particles within half a cell of the plane.

        In their color, or as dots over the cells' pressure.
        """
        h = self.scene.spacing
        near = slice(None) if self.at is None else np.abs(frame.points[:, 2] - self.at) < 0.5 * h
        points, values = frame.points[near], frame.values[near]
        # Upper bound of the inches per meter.
        inches = self.size[0] / DOTS_AN_INCH / self.scene.domain.size[0]
        marker = min(
            max(SMALLEST_DOT, 0.35 * self.recording.particle_spacing() * 72.0 * inches), LARGEST_DOT
        )
        if self.recording.color is Color.PRESSURE and frame.cells is not None:
            axes.scatter(
                points[:, 0],
                points[:, 1],
                s=(0.5 * marker) ** 2,
                color=DOT,
                linewidths=0.0,
                zorder=3,
            )
        else:
            colors = self.recording.scale.colors(values) / 255.0
            axes.scatter(
                points[:, 0],
                points[:, 1],
                s=(2.0 * marker) ** 2,
                c=colors,
                linewidths=0.0,
                zorder=3,
            )

    def _draw_whitewater(self, axes: Axes, frame: RecordedFrame) -> None:
        """Draw spray, foam and bubbles within half a cell of the plane, with an edge."""
        if frame.whitewater is None:
            return
        points = frame.whitewater.points
        kinds = np.clip(frame.whitewater.fields["kind"].astype(int), 0, len(WHITEWATER) - 1)
        for kind, color in enumerate(WHITEWATER):
            near = kinds == kind
            if self.at is not None:
                near &= np.abs(points[:, 2] - self.at) < 0.5 * self.scene.spacing
            axes.scatter(
                points[near, 0],
                points[near, 1],
                s=SMALLEST_DOT**2,
                color=color,
                edgecolors=DOT,
                linewidths=0.25,
                zorder=4,
            )


def cut(triangles: np.ndarray, z: float) -> np.ndarray:
    """Return the segments in which triangles cross a plane z = const.

    Args:
        triangles: corners [m], shape (n, 3, 3).
        z: z of the plane [m].

    Returns:
        Ends of the segments, x and y [m], shape (m, 2, 2).
    """
    above = triangles[..., 2] >= z
    crossing = above.any(axis=1) & ~above.all(axis=1)
    triangles, above = triangles[crossing], above[crossing]
    # The corner on the other side of the plane than the two others.
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    own = np.arange(len(triangles))
    tip = triangles[own, alone]
    ends = []
    for other in (1, 2):
        corner = triangles[own, (alone + other) % 3]
        share = ((z - tip[:, 2]) / (corner[:, 2] - tip[:, 2]))[:, None]
        ends.append((tip + share * (corner - tip))[:, :2])
    segments = np.stack(ends, axis=1)
    under = ~above[own, alone]
    segments[under] = segments[under][:, ::-1]  # all segments have their inside on the same side
    return segments
