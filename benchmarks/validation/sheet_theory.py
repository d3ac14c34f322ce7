"""Folding of a slender viscous sheet: its equations, integrated in time.

A sheet leaves a nozzle straight down and folds periodically on a plate, in two dimensions. The
equations are those of a thin sheet that is stretched and bent [Ribe 2003]: stresses are averaged
over cross-sections. A chain of segments is integrated in time, without any code of the simulator.

Lengths are in fall heights H, speeds in speeds U of the nozzle, and forces in mu U.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

SEGMENTS = 60  # segments over the fall height
STEP = 0.25  # step over the time in which the nozzle extrudes a segment
TURN = 1.5  # length of sheet behind the contact that is not lain on [thickness]
LONGEST_SEGMENT = 1.6  # over the first length; longer ones are divided
TILT = 0.1  # horizontal displacement of the first contact [H]
COLUMNS = 400  # columns of the height map of laid sheet
REACH = 1.5  # half its width [H]
SLOW = 0.2  # speed relative to the plate below which sheet is laid [U]
BAND = 5  # bending couples a node with the second next: 6 unknowns
SETTLING_FOLDS = 4  # half periods that do not count


@dataclass(frozen=True)
class Sheet:
    """Numbers that a folding sheet depends on.

    Args:
        thickness: thickness at the nozzle over the fall height, h / H.
        gravity: rho g H^2 / (mu U).
        reynolds: rho U H / mu.
        descent: speed at which the plate moves down [U].
    """

    thickness: float
    gravity: float = 0.0
    reynolds: float = 0.0
    descent: float = 0.0


@dataclass(frozen=True)
class Folds:
    """Motion of a folding sheet, in units of H and U; row n is at `time[n]`.

    Args:
        sheet: its numbers.
        time: times of the rows, shape (n,).
        middle: horizontal position halfway down, shape (n,).
        contact: horizontal position of the contact, shape (n,).
        height: height from the nozzle to the laid sheet at the contact, shape (n,).
        thickness: thickness at the contact, shape (n,).
    """

    sheet: Sheet
    time: np.ndarray
    middle: np.ndarray
    contact: np.ndarray
    height: np.ndarray
    thickness: np.ndarray

    def reversals(self) -> np.ndarray:
        """Return the times at which the middle passes its mean."""
        return crossings(self.time, self.middle)

    def frequency(self) -> float:
        """Return the folding frequency [U / H]: inverse of the time of two folds."""
        times = self.reversals()[SETTLING_FOLDS:]
        pairs = (len(times) - 1) // 2
        return pairs / float(times[2 * pairs] - times[0]) if pairs else math.nan


def crossings(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the times at which values change their sign, by linear interpolation."""
    before = np.flatnonzero(np.diff(np.signbit(values)))
    part = values[before] / (values[before] - values[before + 1])
    return np.asarray(time[before] + part * (time[before + 1] - time[before]))


class Chain:
    """Chain of segments of constant area, from the laid sheet up to the nozzle.

    Attributes:
        nodes: positions, shape (n, 2); the nozzle is at (0, 1).
        areas: areas of the segments, shape (n - 1,).
        laid: nodes from the start of the chain that lie on the plate.
        pile: height of the laid sheet in each column, shape (COLUMNS,).
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
        self.pile = np.zeros(COLUMNS)

    def columns(self, x: np.ndarray) -> np.ndarray:
        """Return the columns of the height map at horizontal positions."""
        column = (x + REACH) / (2.0 * REACH) * COLUMNS
        return np.clip(column.astype(int), 0, COLUMNS - 1)

    def strain_rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return length rates and turning rates as rows of coefficients, and viscosities.

        A segment's rate of length is t . (v1 - v0), its angular velocity n . (v1 - v0) / l. The
        dissipation is sum 4 mu h / l (l')^2 + sum mu h^3 / (3 l) (omega1 - omega0)^2.

        Returns:
            Coefficients of 2 and 3 successive nodes, each row times the square root of its
            viscosity, shapes (n - 1, 4) and (n - 2, 6).
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
        velocity[: self.laid, 1] = -self.sheet.descent
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
        self.pile -= dt * self.sheet.descent
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

    def thickness_at(self, i: int) -> float:
        """Return the thickness of the segment below node i [H]."""
        return float(self.areas[i - 1] / np.linalg.norm(self.nodes[i] - self.nodes[i - 1]))

    def lay(self) -> None:
        """Lay the sheet up to the last node that touches the plate or sheet laid before."""
        along = np.linalg.norm(np.diff(self.nodes, axis=0), axis=1)
        thickness = np.append(self.sheet.thickness, self.areas / along)
        arc = np.append(0.0, along.cumsum())
        x, y = self.nodes.T
        touches = y - 0.5 * thickness <= self.pile[self.columns(x)]
        # A sheet that turns back lies on what is farther behind it than the turn is long.
        laid, free = slice(0, self.laid), slice(self.laid, None)
        gap = self.nodes[free, None] - self.nodes[None, laid]
        behind = arc[free, None] - arc[None, laid] > TURN * thickness[free, None]
        near = np.hypot(gap[..., 0], gap[..., 1]) < thickness[free, None]
        touches[free] |= (behind & near).any(axis=1)
        self.laid = max(self.laid, len(y) - int(touches[::-1].argmax()) if touches.any() else 0)
        old = int((arc[self.laid - 1] - arc[: self.laid] > 2.0 * TURN * thickness[: self.laid]).sum())
        column = self.columns(x)
        for i in range(1, min(old, self.laid - 2)):
            low, high = sorted(column[i - 1 : i + 1])
            part = self.pile[low : high + 1]
            np.maximum(part, max(y[i - 1], y[i]) + 0.5 * thickness[i], out=part)
        drop = max(0, min(old, self.laid - 2) - 1)
        self.nodes, self.velocity = self.nodes[drop:], self.velocity[drop:]
        self.areas, self.laid = self.areas[drop:], self.laid - drop


def folding_sheet(sheet: Sheet, duration: float, segments: int = SEGMENTS) -> Folds:
    """Return the motion of a sheet from its first contact on.

    Args:
        sheet: the sheet.
        duration: time [H / U].
        segments: segments over the fall height.
    """
    chain, dt = Chain(sheet, segments), STEP / segments
    rows = []
    for step in range(math.ceil(duration / dt)):
        chain.step(dt)
        x, y = chain.nodes[chain.laid - 1 :].T
        first = int((y > 0.5).argmax())  # from below: the lowest crossing of half the height
        part = (0.5 - y[first - 1]) / (y[first] - y[first - 1])
        middle = x[first - 1] + part * (x[first] - x[first - 1])
        slow = np.hypot(*(chain.velocity + [0.0, sheet.descent]).T) < SLOW
        slow[chain.laid - 1] = True
        top = chain.nodes[slow, 1].max()
        rows.append((step * dt + dt, middle, x[0], 1.0 - top, chain.thickness_at(chain.laid)))
    return Folds(sheet, *np.array(rows).T)


def product(band: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the product with a symmetric matrix, stored as its lower diagonals."""
    y = band[0] * x
    for k in range(1, len(band)):
        y[k:] += band[k, :-k] * x[:-k]
        y[:-k] += band[k, :-k] * x[k:]
    return y
