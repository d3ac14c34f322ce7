"""What comes and goes in a run's images besides particles: rigid bodies where they are, and surfaces of sand. Needs the extra `render`."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.simulation import Surface

BODY_COLORS = ["#e07a3f", "#d9b23c", "#7fa650", "#b9586b", "#8d6fb0", "#4d9a94", "#c98f63", "#6f7f95"]
BODY_EDGE = "#4a3b33"
LIGHTER = 0.5  # of the way to white: every other eighth of a ball
BOX_POINTS = 8
ROUND = 1e-3  # how much the distances from the middle of what is round may differ, relative
SURFACE_LOOKS: dict[str, dict[str, Any]] = {  # of a surface that is drawn as it is
    "water": {"color": "#2f86c9", "opacity": 0.75, "specular": 0.6, "specular_power": 40.0, "ambient": 0.35},
    "sand": {"color": "#c9a15f", "ambient": 0.4, "specular": 0.0},
}


class Cast:
    """The bodies and the surface on a plotter.

    Args:
        plotter: pyvista's.
        flat: whether the scene is 2-D.
        line_width: of outlines [pixels].
        behind: z of a 2-D surface [m].
        at_first: the bodies in the run's first frame, which tells the eighths of balls; None: there are none.
    """

    def __init__(self, plotter: Any, *, flat: bool, line_width: float, behind: float, at_first: Surface | None) -> None:
        """Begin with nobody on the stage."""
        self.plotter, self.flat, self.line_width, self.behind, self.at_first = plotter, flat, line_width, behind, at_first
        self._bodies = 0

    def place_bodies(self, bodies: Surface | None) -> None:
        """Draw rigid bodies where they are now, each in a color of its own."""
        for number in range(self._bodies):
            self.plotter.remove_actor(f"body {number}", render=False)
            self.plotter.remove_actor(f"outline {number}", render=False)
        self._bodies = 0
        if bodies is None:
            return
        of_corner = np.asarray(bodies.fields["body"]).ravel()[bodies.corners[:, 0]]
        for number, body in enumerate(np.unique(of_corner)):
            color = BODY_COLORS[number % len(BODY_COLORS)]
            draw = self._draw_flat if self.flat else self._draw_solid
            draw(number, bodies.points, bodies.corners[of_corner == body], color)
            self._bodies = number + 1

    def place_surface(self, surface: Surface, palette: str) -> None:
        """Draw the surface of a material as it is; in 2-D fill it, behind the solids."""
        self.plotter.remove_actor("surface", render=False)
        if not len(surface.corners):
            return
        mesh = self._mesh(surface.points, surface.corners)
        if self.flat:
            mesh = mesh.clean().triangulate_contours().translate((0.0, 0.0, self.behind))
            looks = {"color": SURFACE_LOOKS[palette]["color"], "lighting": False}
        else:
            looks = {"smooth_shading": True, **SURFACE_LOOKS[palette]}
        self.plotter.add_mesh(mesh, name="surface", reset_camera=False, render=False, **looks)

    def _draw_solid(self, number: int, points: np.ndarray, corners: np.ndarray, color: str) -> None:
        """Draw a body; a ball in eighths of two shades, which show how it turns."""
        from matplotlib.colors import to_hex, to_rgb

        mesh = self._mesh(points, corners)
        looks: dict[str, Any] = {"color": color, "smooth_shading": True, "split_sharp_edges": True}
        if self.at_first is not None and len(self.at_first.points) == len(points) and is_round(points, corners):
            own = self.at_first.points[np.unique(corners)]
            mesh["side"] = np.prod(own - 0.5 * (own.min(axis=0) + own.max(axis=0)), axis=1)  # changes its sign between eighths
            pale = LIGHTER + (1.0 - LIGHTER) * np.array(to_rgb(color))
            looks = {"scalars": "side", "cmap": [color, to_hex(pale)], "n_colors": 2, "smooth_shading": True, "show_scalar_bar": False}
            looks["clim"] = np.abs(mesh["side"]).max() * np.array([-1.0, 1.0])
        self.plotter.add_mesh(
            mesh, name=f"body {number}", ambient=0.45, specular=0.25, specular_power=30.0, reset_camera=False, render=False, **looks
        )

    def _draw_flat(self, number: int, points: np.ndarray, corners: np.ndarray, color: str) -> None:
        """Fill an outline, a little before the particles."""
        outline = self._mesh(points, corners).clean()
        before = 1e-3 * float(np.ptp(outline.points, axis=0).max())
        filled = outline.triangulate_contours().translate((0.0, 0.0, before))
        self.plotter.add_mesh(filled, name=f"body {number}", color=color, lighting=False, reset_camera=False, render=False)
        line = outline.translate((0.0, 0.0, 2.0 * before))
        if is_round(points, corners):  # a radius, which shows how the disc turns
            ends = np.stack([points[corners[:, 0]].mean(axis=0), points[corners[0, 0]]])
            line = line.merge(self._mesh(ends + np.array([0.0, 0.0, 2.0 * before]), np.array([[0, 1]])))
        self.plotter.add_mesh(
            line, name=f"outline {number}", color=BODY_EDGE, line_width=self.line_width, lighting=False, reset_camera=False, render=False
        )

    def _mesh(self, points: np.ndarray, corners: np.ndarray) -> Any:
        """Return the part of a surface that has these corners as pyvista's PolyData."""
        import pyvista

        used, own = np.unique(corners, return_inverse=True)
        own = own.reshape(corners.shape)
        if corners.shape[1] == 3:
            return pyvista.PolyData.from_regular_faces(points[used], own)
        return pyvista.PolyData(points[used], lines=np.column_stack([np.full(len(own), 2), own]).ravel())


def is_round(points: np.ndarray, corners: np.ndarray) -> bool:
    """Return whether a body is a disc or a ball: its points [m], more than a box has, lie at one distance from their middle."""
    own = points[np.unique(corners)]
    distance = np.linalg.norm(own - 0.5 * (own.min(axis=0) + own.max(axis=0)), axis=1)
    return len(own) > BOX_POINTS and bool(np.ptp(distance) < ROUND * distance.max())
