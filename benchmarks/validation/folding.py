"""Sheets of thick liquid that fold on a plate, in two dimensions.

The frequency is that of a slender sheet, from `sheet_theory`, at the mean height of the fall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from warp_lcp.benchmarks.validation.coiling import (
    FLOOR,
    HEIGHT,
    LONGEST,
    REYNOLDS,
    SHARE,
    SOURCE,
    SPEED,
    STEP,
    WITHIN,
)
from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at, plot
from warp_lcp.benchmarks.validation.scenes import (
    DENSITY,
    SUB_CELL,
    Row,
    box,
    create_liquid,
    positions,
    steps,
    velocities,
)
from warp_lcp.benchmarks.validation.sheet_theory import (
    LEVEL,
    SLOW,
    TILT,
    FoldingMotion,
    Sheet,
    folding_frequency,
)

WIDTH = 0.8  # half the domain's width over the height
LAYER = 2  # slow particles over the sheet's cells in a layer of laid sheet
SETTLING = 1  # folds that do not count


@dataclass(frozen=True)
class FallingSheet:
    """A sheet that falls onto a plate, and its grid.

    Args:
        cells: cells of its thickness.
        heights: fall height over the thickness.
        gravity: rho g H^2 / (mu U).
        descent: speed of the plate over the nozzle's, about that of a pile's growth.
        duration: duration of the run [H / U].
    """

    cells: int
    heights: int
    gravity: float
    descent: float
    duration: float

    @property
    def across(self) -> int:
        """Fall height [cells]."""
        return self.cells * self.heights

    def at(self, height: float, *, heavy: bool = True) -> Sheet:
        """Return the numbers of the theory for a fall height [H], or without gravity."""
        gravity = self.gravity * height**2 if heavy else 0.0
        thickness = 1.0 / (self.heights * height)
        return Sheet(round(thickness, 6), round(gravity, 6), round(REYNOLDS * height, 8))

    def expected(self, height: float, *, heavy: bool = True) -> float:
        """Return the frequency in theory [U over the height]."""
        return folding_frequency(self.at(height, heavy=heavy))


VISCOUS = {cells: FallingSheet(cells, 10, 0.0, descent=0.2, duration=6.0) for cells in (6, 8)}
HEAVY = {cells: FallingSheet(cells, 20, 2.0, descent=0.13, duration=3.5) for cells in (4, 6)}


def falling_sheet(setup: FallingSheet) -> FoldingMotion:
    """Return the motion of a sheet that starts straight, tilted at its lower end.

    Units are H and U, as in the theory; laid liquid is as slow as laid sheet there.

    Args:
        setup: the sheet.
    """
    n, dx = setup.across, HEIGHT / setup.across
    plate = math.ceil(setup.descent * setup.duration * n) + FLOOR
    nozzle, half = plate + n, math.ceil(WIDTH * n)
    counts = 2 * half + setup.cells % 2, nozzle + SOURCE
    size, axis = [counts[0] * dx, counts[1] * dx], 0.5 * counts[0] * dx
    viscosity = DENSITY * SPEED * HEIGHT / REYNOLDS
    wide = 0.5 * setup.cells * dx
    simulation = create_liquid(
        SUB_CELL,
        size,
        max(counts),
        tilted_sheet(setup, np.array([axis, plate * dx]), size[1]),
        domain={
            "size": size,
            "resolution": max(counts),
            "open": ["left", "right"],
            "wall": "sticky",
        },
        source=[
            box(
                [axis - wide + 0.01 * dx, (nozzle + 0.1) * dx],
                [axis + wide - 0.01 * dx, size[1]],
                velocity=[0.0, -SPEED],
            )
        ],
        solid=[
            box(
                [-1.0, -1.0],
                [1.0, plate * dx],
                motion={"kind": "translation", "velocity": [0.0, -setup.descent * SPEED]},
            )
        ],
        viscosity={"value": viscosity, "splitting_tolerance": SHARE},
        physics={"gravity": [0.0, -setup.gravity * viscosity * SPEED / (DENSITY * HEIGHT**2)]},
        # Viscosity holds the liquid: gravity, which `cfl` includes, does not limit the step.
        time={"duration": LONGEST, "cfl": 16.0, "dt_max": STEP * dx / SPEED},
    )
    rows = list[tuple[float, float, float]]()
    level = round(plate + LEVEL * n)
    for _ in steps(simulation, setup.duration * HEIGHT / SPEED):
        x, y = positions(simulation).T / dx
        layer = y.astype(int)
        speed = np.hypot(*(velocities(simulation).T / SPEED + [[0.0], [setup.descent]]))
        laid = np.bincount(layer[speed < SLOW], minlength=counts[1]) >= LAYER * setup.cells
        top = np.flatnonzero(laid)[-1] + 1 if laid.any() else plate
        height = (nozzle - top) / n + 0.5 / setup.heights
        position = float(x[layer == level].mean()) - axis / dx
        rows.append((simulation.time * SPEED / HEIGHT, position / n, height))
    return FoldingMotion(*np.array(rows).T)


def tilted_sheet(setup: FallingSheet, foot: np.ndarray, top: float) -> list[Row]:
    """Return capsules along the theory's first shape.

    Args:
        setup: the sheet.
        foot: place on the plate below the nozzle [m], shape (2,).
        top: height of the domain [m].
    """
    radius = 0.5 / setup.heights
    y = np.linspace(radius, 1.0, 40)
    line = foot + HEIGHT * np.stack([TILT * (1.0 - y) ** 2, y], axis=1)
    line = np.vstack([line, [foot[0], top]])
    return [
        {"shape": "capsule", "from": p.tolist(), "to": q.tolist(), "radius": radius * HEIGHT}
        for p, q in pairwise(line)
    ]


def compare(findings: Findings, setup: FallingSheet) -> None:
    """Compare a frequency with the theory, for the mean fall height of the folds."""
    motion = falling_sheet(setup)
    halves, heights = motion.folds()
    folds = 2 * ((len(halves) - SETTLING) // 2)  # whole periods: folds may lie off the axis
    found = motion.frequency(folds)
    height = round(float(heights[-folds:].mean()), 2)
    findings.add(
        "frequency over expected", found / setup.expected(height), low=1 - WITHIN, high=1 + WITHIN
    )
    findings.add("folds", folds, low=4)
    if setup.gravity:
        wrong = setup.expected(height, heavy=False)
        findings.must_break(
            "theory without gravity: frequency over expected", found / wrong, high=1 + WITHIN
        )
    else:
        # The frequency is about U / H: that of half the height is twice as large.
        wrong = 2.0 * setup.expected(height)
        findings.must_break(
            "theory of half the height: frequency over expected", found / wrong, low=1 - WITHIN
        )
    findings.curve("position", motion.time, motion.position)


@check_at("folding", "viscous sheet, {cells} cells of its thickness")
def viscous_sheet(findings: Findings, cells: int) -> None:
    """Compare a sheet without gravity, whose folds are as wide as the height allows."""
    compare(findings, VISCOUS[cells])


@check_at("folding", "heavy sheet, {cells} cells of its thickness")
def heavy_sheet(findings: Findings, cells: int) -> None:
    """Compare a sheet whose weight bends it above the plate."""
    compare(findings, HEAVY[cells])


CHECK = ValidationCheck(
    about="A sheet of thick liquid folds on a plate, in 2-D, almost without inertia. The frequency "
    "is that of a slender sheet (Ribe 2003), 0.63 U / H for thin ones without gravity; weight "
    "makes folds narrower. The plate moves down about as fast as the folds pile up, and the height "
    "counts down to liquid that is slow relative to the plate. The theory's plate is fixed, and "
    "its folds have no height.",
    trials=[(viscous_sheet, tuple(VISCOUS)), (heavy_sheet, tuple(HEAVY))],
    charts=[
        plot(
            "folding", "Folding sheets", "time [H / U]", "position [H]", "position", check="folding"
        )
    ],
)
