"""Probes: pressure, velocity and surface height at points, one row per step.

They are written to `probes.csv`.
"""

import math
import typing
from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.fluids.drag_and_probe_tables import Probe
from warp_lcp.grid.cell_kernel import F32, F64, I8, interpolated
from warp_lcp.grid.staggered import StaggeredGrid, three_components
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import LaunchGraph, launch
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.particle_log import Row
from warp_lcp.operators.grid_poisson import FLUID, SOLID

if typing.TYPE_CHECKING:
    from warp_lcp.fluids.simulator import LiquidSimulation

_FLUID, _SOLID = wp.constant(wp.int8(FLUID)), wp.constant(wp.int8(SOLID))
STEP = wp.constant(0.25)  # step of the search for the surface [cells]
# Values per probe: pressure over density, velocity (3), level, and whether the search has ended in
# liquid.
VALUES = 6
FAR = 1e9  # larger than any grid [cells]

options: dict[str, str] = {"module": "fluids.probes"}


@wp.func
@typing.no_type_check
def corner(x: wp.vec3, n: int, planes: int, shape: wp.vec3i):
    """Return corner n of the cube of cell centers around a point, and its weight.

    The point is in array coordinates; the weight is that of trilinear interpolation.
    """
    high = wp.vec3i(n & 1, (n >> 1) & 1, n >> 2)
    at = wp.vec3i(0, 0, 1)
    share = float(1.0)
    for axis in range(planes + 1):
        c = wp.clamp(x[axis], 0.0, float(shape[axis]) - 1.001)
        at[axis] = int(c) + high[axis]
        f = c - float(int(c))
        share *= wp.where(high[axis] == 1, f, 1.0 - f)
    return at, share


@wp.func
@typing.no_type_check
def depth_of(x: wp.vec3, planes: int, shape: wp.vec3i, kind: I8, phi: F32):
    """Return the depth of a point below the free surface, and the open weight.

    The depth is interpolated from the cells that are not SOLID. The second value is the sum of
    their interpolation weights.
    """
    deep = float(0.0)
    total = float(0.0)
    for n in range(4 * planes):
        at, share = corner(x, n, planes, shape)
        what = kind[at[2], at[1], at[0]]
        if what != _SOLID:
            value = wp.where(what == _FLUID, 0.5, -0.5)
            if phi:
                value = -phi[at[2], at[1], at[0]]
            deep += share * value
            total += share
    return deep, total


@forward_kernel(**options)
@typing.no_type_check
def probe_kernel(
    points: wp.array(dtype=wp.vec3),
    counts: wp.vec3i,
    planes: int,
    kind: I8,
    x: F64,
    phi: F32,
    u: F32,
    v: F32,
    w: F32,
    kick_x: float,
    kick_y: float,
    kick_z: float,
    up: wp.vec3,
    reach: wp.array(dtype=wp.vec2),
    values: wp.array2d(dtype=wp.float64),
):
    """Find x [m/s], velocity [m/s] and level [cells] at points.

    Points are in array coordinates, in which cell i reaches from i to i + 1. The kick [m/s] is the
    change of x by gravity from a cell to the next along each axis. `up` is the unit vector against
    gravity. The search for the surface covers distances between the two values of `reach` [cells]
    from the point.
    """
    t = wp.tid()
    kick = wp.vec3(kick_x, kick_y, kick_z)
    shape = counts + wp.vec3i(2, 2, 2)
    p = points[t]
    inside = bool(True)
    cell = wp.vec3i(1, 1, 1)
    for axis in range(planes + 1):
        inside = inside and p[axis] >= 1.0 and p[axis] <= float(counts[axis]) + 1.0
        cell[axis] = wp.clamp(int(p[axis]), 1, counts[axis])
    for n in range(6):
        values[t, n] = wp.float64(0.0)
    c = p - wp.vec3(0.5, 0.5, 0.5)
    wet = bool(False)
    if inside:
        wet = kind[cell[2], cell[1], cell[0]] == _FLUID
    if not wet:
        for n in range(1, 4):
            values[t, n] = wp.float64(wp.nan)
    if wet:
        pressure = wp.float64(0.0)
        total = float(0.0)
        for n in range(4 * planes):
            at, share = corner(c, n, planes, shape)
            if kind[at[2], at[1], at[0]] == _FLUID:
                off = c - wp.vec3(float(at[0]), float(at[1]), float(at[2]))
                rise = float(0.0)
                for axis in range(planes + 1):
                    rise += kick[axis] * off[axis]
                pressure += wp.float64(share) * (x[at[2], at[1], at[0]] + wp.float64(rise))
                total += share
        if total > 0.0:
            values[t, 0] = pressure / wp.float64(total)
        values[t, 1] = wp.float64(interpolated(u, planes, p[0], c[1], c[2]))
        values[t, 2] = wp.float64(interpolated(v, planes, c[0], p[1], c[2]))
        if planes == 2:
            values[t, 3] = wp.float64(interpolated(w, planes, c[0], c[1], p[2]))
    if reach[t][0] < reach[t][1]:
        room = reach[t][1]  # limited by the grid's end below
        for axis in range(planes + 1):
            if up[axis] != 0.0:
                end = wp.where(up[axis] > 0.0, float(counts[axis]) + 1.0, 1.0)
                room = wp.min(room, (end - p[axis]) / up[axis])
        level = reach[t][0]
        deep, total = depth_of(c + level * up, planes, shape, kind, phi)
        looking = bool(deep > 0.0)
        while looking:
            way = wp.min(STEP, room - level)
            last = deep
            deep, total = depth_of(c + (level + way) * up, planes, shape, kind, phi)
            looking = total > 0.0 and way > 0.0
            if way <= 0.0:
                values[t, 5] = wp.float64(1.0)
            if looking:
                if deep <= 0.0:
                    level += way * last / (last - deep)
                    looking = False
                else:
                    level += way
        values[t, 4] = wp.float64(level)


class Probes:
    """Measure pressure, velocity and level at fixed points; `row` is collective.

    Pressure is interpolated trilinearly from the liquid's cells. Of the eight cells around a point,
    air and solids are left out, and the pressure of the others is extrapolated to the point with
    the hydrostatic gradient rho g. Velocity is interpolated trilinearly from the faces of each
    component. Where the point's cell holds no liquid, pressure is 0 and velocity is empty.

    The level is the distance from the point against gravity to the first surface above it, or to a
    solid or the domain's end before that; 0 if the point is not in liquid.

    Args:
        probes: the probes of the scene.
        gravity: [m/s^2], shape (3,).
        grid: the grid.
    """

    def __init__(self, probes: Sequence[Probe], gravity: np.ndarray, grid: StaggeredGrid) -> None:
        self.probes, self.gravity, self.dimension = tuple(probes), gravity, grid.dimension
        size = math.hypot(*gravity)  # hypot does not underflow where the squares do
        self._up = -gravity / size if size > 0.0 else np.zeros(3)
        self._points = np.array([[*probe.position, 0.0][:3] for probe in probes])
        self._grid: StaggeredGrid | None = None  # grid of the last measurement
        self._kick = [Scalar() for _ in range(3)]

    def columns(self) -> tuple[str, ...]:
        """Return the column names of all probes.

        NAME_pressure [Pa], NAME_level [m], NAME_vx, NAME_vy and in 3-D NAME_vz [m/s].
        """
        return tuple(column for probe in self.probes for column in probe.columns(self.dimension))

    def row(self, simulation: "LiquidSimulation") -> Row:
        """Return the values of a step, before anything moves.

        The kernels measure in units of the grid: p = x rho dx / kick_dt [Pa], and a level is dx
        times its height in cells [m]. Velocities are in m/s.
        """
        found, scale = (
            self._measure(simulation),
            simulation.scene.physics.density * simulation.grid.spacing / simulation.kick_dt,
        )
        row: Row = {}
        for probe, values in zip(self.probes, found, strict=True):
            shown_values = {
                "pressure": values[:1] * scale,
                "velocity": values[1:4],
                "level": values[4:5] * simulation.grid.spacing,
            }
            row |= dict(
                zip(
                    probe.columns(self.dimension),
                    shown_values[probe.quantity].tolist(),
                    strict=False,
                )
            )
        return row

    def _reach(self, grid: StaggeredGrid) -> np.ndarray:
        """Return the distances between which the surface is searched, shape (probes, 2).

        In cells; 0 and 0 if there is no search.
        """
        # Without gravity no direction is up and no probe has a level: the search would not end.
        if not self._up.any():
            return np.zeros((len(self.probes), 2))
        if grid.part.shared:
            return self._ways_through(grid)
        cells = grid.to_grid(self._points)[:, : grid.dimension] - grid.origin[: grid.dimension]
        inside = np.all(
            (cells >= 1.0) & (cells <= np.array(grid.counts[: grid.dimension]) + 1.0),
            axis=1,
            keepdims=True,
        )
        return np.where(inside, [0.0, FAR], 0.0)

    def _ways_through(self, grid: StaggeredGrid) -> np.ndarray:
        """Return the distances at which the search passes through this rank's box.

        Shape (probes, 2), in whole steps of the search [cells].
        """
        axes = slice(grid.dimension)
        start, up = grid.to_grid(self._points)[:, axes], self._up[axes]
        first_cell, window = np.array(grid.part.first)[axes], grid.part.owned
        size = (np.array(window.high) - np.array(window.low))[::-1][axes]
        low, high = first_cell + 1.0, first_cell + size + 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            ways = np.stack([(low - start) / up, (high - start) / up])
        inside = (start >= low) & (start <= high)
        first = np.where(up == 0.0, np.where(inside, -np.inf, np.inf), ways.min(axis=0)).max(axis=1)
        last = np.where(up == 0.0, np.where(inside, np.inf, -np.inf), ways.max(axis=0)).min(axis=1)
        begin, end = STEP * np.floor(np.maximum(first, 0.0) / STEP), STEP * np.ceil(last / STEP)
        meets = (last >= 0.0) & (last >= first) & np.isfinite(begin)
        return np.where(
            meets[:, None], np.stack([begin, np.maximum(end, begin + STEP)], axis=1), 0.0
        )

    def _joined(self, own_rows: np.ndarray, reach: np.ndarray, grid: StaggeredGrid) -> np.ndarray:
        """Return the values of all probes, combined from all ranks.

        The rank whose box has the point gives pressure and velocity. The ranks along the search
        upward give the level.
        """
        cells = np.floor(grid.to_grid(self._points)).astype(np.int64) - 1
        owner = grid.part.owners(np.clip(cells, 0, np.array(grid.domain_counts) - 1))
        everyone = grid.part.ranks.gather(np.concatenate([own_rows, reach], axis=1))
        combined = np.asarray(everyone[owner, np.arange(len(owner)), : own_rows.shape[1]])
        for probe, values in enumerate(combined):
            ways = [rank for rank in everyone[:, probe] if rank[-1] > rank[-2]]
            for rank in sorted(ways, key=lambda rank: float(rank[-2])):
                values[4] = rank[4]
                if rank[5] == 0.0:  # the search has ended at the surface or a solid
                    break
        return combined

    def _measure(self, simulation: "LiquidSimulation") -> np.ndarray:
        """Return x [m/s], velocity [m/s] and level [cells] of each probe."""
        grid, projection, velocity = (
            simulation.grid,
            simulation.projection,
            three_components(simulation.velocity),
        )
        if self._grid is not grid:
            self._grid, self._measuring = grid, LaunchGraph(grid.device, self._launch)
            points = (grid.to_grid(self._points) - grid.origin).astype(np.float32)
            self._at = wp.array(points, dtype=wp.vec3, device=grid.device)
            self._reached = self._reach(grid)
            self._ways = wp.array(
                self._reached.astype(np.float32), dtype=wp.vec2, device=grid.device
            )
            self._values = wp.zeros(
                (len(self.probes), VALUES), dtype=wp.float64, device=grid.device
            )
        for number, change in zip(self._kick, self.gravity * simulation.kick_dt, strict=True):
            number.value = float(change)
        self._measuring.run(
            [projection.kind, projection.pressure, simulation.surface.phi, *velocity]
        )
        mine = np.array(self._values.numpy())
        return self._joined(mine, self._reached, grid) if grid.part.shared else mine

    def _launch(self, fields: list[wp.array | None]) -> None:
        """Launch the kernel at all points."""
        assert self._grid is not None, "the grid is known"
        counts, up = wp.vec3i(*self._grid.counts), wp.vec3(*self._up)
        inputs = [
            self._at,
            counts,
            self._grid.planes,
            *fields,
            *self._kick,
            up,
            self._ways,
            self._values,
        ]
        launch(probe_kernel, len(self.probes), inputs, device=self._grid.device)
