"""Folding of a slender viscous sheet: its equations, integrated in time.

A sheet leaves a nozzle straight down and folds periodically on a plate, in two dimensions. The
equations are those of a thin sheet that is stretched and bent [Ribe 2003]. A chain of segments
follows the sheet, without any code of the simulator.

Lengths are in fall heights H, speeds in speeds U of the nozzle, and forces in mu U.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded

SEGMENTS = 80  # segments over the fall height
STEP = 0.25  # step over the time in which the nozzle extrudes a segment
LONGEST_SEGMENT = 1.6  # over the first length; longer ones are halved
TILT = 0.1  # horizontal displacement of the first contact [H]
BAND = 5  # lower diagonals: bending couples a node with the second next
HELD = 3  # laid nodes that are kept
SLOW = 0.2  # speed relative to the plate below which liquid counts as laid [U]
LEVEL = 0.3  # height over the plate at which the sheet's position is taken [H]
DURATION = 12.0  # of the motion [H / U]
FOLDS = 12  # half periods at its end that are averaged


@dataclass(frozen=True)
class Sheet:
    """Numbers that a folding sheet depends on.

    Args:
        thickness: thickness at the nozzle over the fall height, h / H.
        gravity: rho g H^2 / (mu U).
        reynolds: rho U H / mu.
    """

    thickness: float
    gravity: float = 0.0
    reynolds: float = 0.0


@dataclass(frozen=True)
class FoldingMotion:
    """Motion of a folding sheet.

    Args:
        time: times, shape (n,).
        position: horizontal position of the sheet at `LEVEL`, shape (n,).
        height: height from the nozzle down to the laid sheet's axis, shape (n,).
    """

    time: np.ndarray
    position: np.ndarray
    height: np.ndarray

    def folds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the half periods and the mean height of each, shape (m,)."""
        times = crossings(self.time, self.position)
        within = [(self.time >= t) & (self.time < u) for t, u in pairwise(times)]
        return np.diff(times), np.array([self.height[part].mean() for part in within])

    def frequency(self, folds: int) -> float:
        """Return the frequency of the last folds [U over the mean height]."""
        halves, heights = self.folds()
        if len(halves) < folds:
            return math.nan
        return float(heights[-folds:].sum() / (2.0 * halves[-folds:].sum()))


def crossings(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the times at which values change their sign, by linear interpolation."""
    before = np.flatnonzero(np.diff(np.signbit(values)))
    part = values[before] / (values[before] - values[before + 1])
    return np.asarray(time[before] + part * (time[before + 1] - time[before]))


class Chain:
    """Chain of segments of constant area, from the laid sheet up to the nozzle.

    The plate is at y = 0, and laid sheet does not raise it.

    Attributes:
        nodes: positions, shape (n, 2); the nozzle is at (0, 1).
        velocity: of the nodes, shape (n, 2).
        areas: areas of the segments, shape (n - 1,).
        laid: nodes from the start of the chain that lie on the plate.
    """

    def __init__(self, sheet: Sheet, segments: int) -> None:
        self.sheet, self.spacing = sheet, 1.0 / segments
        y = np.arange(0.5 * sheet.thickness, 1.0 + 2.5 * self.spacing, self.spacing)
        x = TILT * np.clip(1.0 - y, 0.0, 1.0) ** 2
        self.nodes = np.stack([x, y], axis=1)
        length = np.linalg.norm(np.diff(self.nodes, axis=0), axis=1)
        self.areas = sheet.thickness * length
        self.velocity = np.zeros_like(self.nodes)
        self.velocity[:, 1] = -1.0
        self.laid = 2  # two nodes: the sheet does not turn at the contact

    def strain_rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return coefficients of the rates of length and of turning.

        A segment's rate of length is t . (v1 - v0), its angular velocity n . (v1 - v0) / l. The
        dissipation is sum 4 mu h / l (l')^2 + sum mu h^3 / (3 l) (omega1 - omega0)^2.

        Returns:
            Coefficients of the velocities of 2 and 3 successive nodes, times the square root of
            the dissipation per squared rate, shapes (n - 1, 4) and (n - 2, 6).
        """
        along = np.diff(self.nodes, axis=0)
        length = np.linalg.norm(along, axis=1)
        tangent = along / length[:, None]
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        thickness = self.areas / length
        stretch = np.hstack([-tangent, tangent]) * np.sqrt(4.0 * thickness / length)[:, None]
        turn = normal / length[:, None]
        between = 0.5 * (length[1:] + length[:-1])
        thick = 0.5 * (self.areas[1:] + self.areas[:-1]) / between
        bend = np.hstack([turn[:-1], -turn[:-1] - turn[1:], turn[1:]])
        return stretch, bend * np.sqrt(thick**3 / (3.0 * between))[:, None]

    def step(self, dt: float) -> None:
        """Solve the balance of forces for the velocity [U], and move the nodes.

        The velocity minimizes half the dissipation less the power of gravity and inertia. It is
        given at laid nodes and at those above the nozzle.
        """
        n = len(self.nodes)
        first_held = n - int((self.nodes[::-1, 1] > 1.0).argmin())
        velocity = np.zeros((n, 2))
        velocity[first_held:, 1] = -1.0
        mass = np.zeros(n)
        mass[1:] += 0.5 * self.areas
        mass[:-1] += 0.5 * self.areas
        inertia = self.sheet.reynolds * mass / dt
        band = np.zeros((BAND + 1, 2 * n))
        band[0] = np.repeat(inertia, 2)
        for rows in self.strain_rates():
            first = 2 * np.arange(len(rows))
            for i in range(rows.shape[1]):
                for j in range(i + 1):
                    band[i - j, first + j] += rows[:, i] * rows[:, j]
        force = inertia[:, None] * self.velocity
        force[:, 1] -= self.sheet.gravity * mass
        free = slice(2 * self.laid, 2 * first_held)
        part = band[:, free].copy()
        for k in range(1, BAND + 1):
            part[k, -k:] = 0.0  # couplings with the nozzle
        load = force.ravel() - product(band, velocity.ravel())
        velocity.ravel()[free] = solveh_banded(part, load[free], lower=True)
        self.velocity = velocity
        self.nodes += dt * velocity
        self.extrude()
        self.divide()
        self.lay()

    def extrude(self) -> None:
        """Append a node above the nozzle when the last one has come down."""
        if self.nodes[-1, 1] < 1.0 + 2.0 * self.spacing:
            self.nodes = np.vstack([self.nodes, self.nodes[-1] + [0.0, self.spacing]])
            self.velocity = np.vstack([self.velocity, [0.0, -1.0]])
            self.areas = np.append(self.areas, self.sheet.thickness * self.spacing)

    def divide(self) -> None:
        """Halve the free segments that have become long."""
        length = np.linalg.norm(np.diff(self.nodes, axis=0), axis=1)
        length[: self.laid] = 0.0
        long = np.flatnonzero(length > LONGEST_SEGMENT * self.spacing)
        if len(long):
            self.nodes, self.velocity = (
                np.insert(field, long + 1, 0.5 * (field[long] + field[long + 1]), axis=0)
                for field in (self.nodes, self.velocity)
            )
            self.areas = np.insert(self.areas, long + 1, 0.5 * self.areas[long])
            self.areas[long + np.arange(len(long))] *= 0.5

    def lay(self) -> None:
        """Lay the sheet up to the last node at which its lower side touches the plate."""
        length = np.linalg.norm(np.diff(self.nodes, axis=0), axis=1)
        touches = np.flatnonzero(self.nodes[1:, 1] < 0.5 * self.areas / length)
        if len(touches):
            self.laid = max(self.laid, int(touches[-1]) + 2)
            self.velocity[: self.laid] = 0.0
        drop = max(0, self.laid - HELD)
        self.nodes, self.velocity = self.nodes[drop:], self.velocity[drop:]
        self.areas, self.laid = self.areas[drop:], self.laid - drop


@cache
def folding_sheet(
    sheet: Sheet, duration: float = DURATION, segments: int = SEGMENTS
) -> FoldingMotion:
    """Return the motion of a sheet from its first contact on, in units of H and U.

    Args:
        sheet: the sheet.
        duration: time [H / U].
        segments: segments over the fall height.
    """
    chain, dt = Chain(sheet, segments), STEP / segments
    rows = list[tuple[float, float, float]]()
    for step in range(math.ceil(duration / dt)):
        chain.step(dt)
        x, y = chain.nodes[chain.laid - 1 :].T
        first = int((y > LEVEL).argmax())  # the lowest crossing
        part = (LEVEL - y[first - 1]) / (y[first] - y[first - 1])
        slow = np.hypot(*chain.velocity.T) < SLOW
        rows.append(
            (
                (step + 1) * dt,
                float(x[first - 1] + part * (x[first] - x[first - 1])),
                1.0 - float(chain.nodes[slow, 1].max()),
            )
        )
    return FoldingMotion(*np.array(rows).T)


@cache
def folding_frequency(sheet: Sheet) -> float:
    """Return the frequency of periodic folding [U over the mean height]."""
    return folding_sheet(sheet).frequency(FOLDS)


def product(band: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the product with a symmetric matrix, stored as its lower diagonals."""
    y = band[0] * x
    for k in range(1, len(band)):
        y[k:] += band[k, :-k] * x[:-k]
        y[:-k] += band[k, :-k] * x[k:]
    return y
