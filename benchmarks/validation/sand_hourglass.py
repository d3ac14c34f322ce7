"""Discharge of sand through a slot: constant in time, and its law of the width.

The rate does not depend on the fill and grows as (D - delta)^(3/2) with the slot D. The discharge
of a liquid falls with the square root of its height. The bin's floor is rough: its friction is the
sand's own. delta is a property of grains; in a continuum it is near 0.

The constant of the law depends on the friction and on the outlet. The trial `reference` takes the
set-up of a continuum code with mu(I), Basilisk [silo2DCo.c]: an incompressible fluid of yield
stress mu(I) p, with a volume fraction and no grain's size but in I. There the slot is part of the
bottom of the domain, and the pressure in it is 0: here sand is removed below the floor's surface.
Walls and floor hold the fluid. Rates are volumes of the bulk, not of grains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from warp_lcp.benchmarks.harness.record import RecordLines
from warp_lcp.benchmarks.validation import scenes
from warp_lcp.benchmarks.validation.finding import (
    Findings,
    ValidationCheck,
    ValidationTrial,
    attempt,
    check_at,
    plot,
)
from warp_lcp.benchmarks.validation.scenes import (
    CORRECTED,
    GRAVITY,
    Row,
    box,
    create_liquid,
    create_sand,
    positions,
    share_solved,
    steps,
)
from warp_lcp.files import Tables, TableValue

OPENINGS = {1: (8, 12, 16), 2: (16,)}  # cells of the slot, by refinement
# [m] Bin, initial sand, and the room below.
WIDTH, DEPTH, BELOW = 0.24, 0.44, 0.12
SPACING = 0.005  # [m] before refinement
PLATE = 2  # cells of the bin's floor, before refinement
# Range of the fill in which the discharge is measured [widths]; at first it grows.
FIRST, LEAST = 1.65, 1.2
LOW = 0.3  # fill down to which the liquid is measured
PARTS = 5  # parts of the range
WALLS = 0.4  # friction of the side walls

# Rates / sqrt(g D^3) by Basilisk, silo2DCo.c without cohesion on 128 cells: 1.9501, 1.6839, 1.4292,
# 1.2190 and 1.0806 sqrt(g L^3). D is 12 of its cells, of 10 L / 128; mu_s is the key.
# granular_sandglass.c, another set-up, has 1.525 with mu_s = 0.32, between these two.
REFERENCE = {0.1: 2.148, 0.2: 1.855, 0.3: 1.574, 0.4: 1.343, 0.5: 1.190}
REFERENCE_CELLS = (12, 24)  # cells of the slot
# mu(I): growth of mu, I_0, and diameter of grains over the slot's width.
GROWTH, INERTIAL_NUMBER, GRAIN = 0.28, 0.4, 1.0 / 30.0 * 12.8 / 12.0
BASIN, FILLED = 128.0 / 12.0, 57.6 / 12.0  # width of the silo and height of its sand [slots]
OUTFLOW = (3.0, 4.0)  # time in which the rate is measured [sqrt(D / g)]
JET = 6  # cells below the floor's surface


class Discharge(NamedTuple):
    """Discharge of a bin."""

    fill: np.ndarray  # in the middle of each part of the range [widths]
    rate: np.ndarray  # in each part [m^2/s]
    solved: float = math.nan  # share of the steps within the error [%]

    @property
    def spread(self) -> float:
        """Range of the rates over their mean [%]."""
        return 100.0 * float(np.ptp(self.rate) / self.rate.mean())


def trial(refinement: int, openings: tuple[int, ...] = ()) -> ValidationTrial:
    """Measure the discharge of slots of several widths in cells.

    The control is a liquid.
    """

    def run(findings: Findings) -> None:
        dx, rates, chosen_openings = SPACING / refinement, [], openings or OPENINGS[refinement]
        for cells in chosen_openings:
            d, label = sand(cells, refinement), f"D = {cells} cells"
            rates.append(float(d.rate.mean()))
            findings.add(
                f"{label}: spread of the rate while fill > {LEAST:g} widths",
                d.spread,
                high=8.0,
                unit="%",
            )
            findings.add(
                f"{label}: rate / sqrt(g D^3)",
                rates[-1] / math.sqrt(GRAVITY * (cells * dx) ** 3),
                low=0.7,
                high=1.3,
            )
            findings.add(f"{label}: steps within the error", d.solved, low=95.0, unit="%")
            findings.curve(label, d.fill, d.rate / d.rate[0])
        if len(chosen_openings) > 2:
            root = np.array(rates) ** (2.0 / 3.0)
            slope, offset = np.polyfit(np.array(chosen_openings), root, 1)
            fitted = slope * np.array(chosen_openings) + offset
            findings.add(
                "delta of rate ~ (D - delta)^(3/2)",
                -offset / slope,
                low=-0.5,
                high=0.5,
                unit="cells",
            )
            findings.add(
                "worst rate off that law",
                100.0 * np.abs((root / fitted) ** 1.5 - 1.0).max(),
                high=4.0,
                unit="%",
            )
            findings.curve("law", dx * np.array(chosen_openings), root)
        high, w = liquid(8)
        findings.must_break(
            f"liquid: spread of the rate while fill > {LEAST:g} widths",
            high.spread,
            high=8.0,
            unit="%",
        )
        findings.add(
            "liquid: exponent of the rate over height",
            np.polyfit(np.log(w.fill), np.log(w.rate), 1)[0],
            low=0.4,
            high=0.6,
        )
        findings.curve("liquid", w.fill, w.rate / w.rate[0])

    return attempt("sand hourglass", f"cells of {1000.0 * SPACING / refinement:g} mm", run)


def sand(
    cells: int, refinement: int, floor: float | str = "stick", **tables: TableValue
) -> Discharge:
    """Simulate sand that runs through a slot on a floor with friction."""
    dx = SPACING / refinement
    size, solids, fill, drain = _bin(cells * dx, DEPTH)
    solids = [solid | {"friction": floor} for solid in solids]
    simulation = create_sand(
        size,
        round(max(size) / dx),
        [fill],
        solids,
        walls=WALLS,
        drain=[drain],
        **(CORRECTED | tables),
    )
    area = simulation.particle_mass / simulation.scene.physics.density
    rows: list[Row] = []
    curve = _empty(simulation, area, LEAST, rows)
    return Discharge(*_rates(*curve, FIRST, LEAST, PARTS), share_solved(rows))


def liquid(cells: int) -> tuple[Discharge, Discharge]:
    """Simulate a liquid that runs through a slot.

    Return the discharge in the range of sand, and the one down to LOW.
    """
    size, solids, fill, drain = _bin(cells * SPACING, DEPTH)
    simulation = create_liquid(
        scenes.VOXEL,
        size,
        round(max(size) / SPACING),
        [fill],
        solid=solids,
        drain=[drain],
        **CORRECTED,
    )
    curve = _empty(simulation, SPACING**2 / scenes.PER_AXIS**2, LOW, [])
    return Discharge(*_rates(*curve, FIRST, LEAST, PARTS)), Discharge(
        *_rates(*curve, FIRST, LOW, 2 * PARTS)
    )


@check_at("sand hourglass", "rates by another code, D = {cells} cells")
def reference(
    findings: Findings, cells: int, frictions: tuple[float, ...] = tuple(REFERENCE)
) -> None:
    """Compare rates with those of a continuum code.

    The controls are the friction of Narain et al., whose set is a box, and half of the friction.
    """
    rates = [silo_rate(cells, mu) for mu in frictions]
    for mu, rate in zip(frictions, rates, strict=True):
        findings.add(
            f"mu_s = {mu:g}: rate / sqrt(g D^3) over the reference's",
            rate / REFERENCE[mu],
            low=0.92,
            high=1.08,
        )
    findings.curve("rate", frictions, rates)
    steep = frictions[-1]
    for label, rate in (
        ("box", silo_rate(cells, steep, friction={"model": "box"})),
        ("half of the friction", silo_rate(cells, 0.5 * steep)),
    ):
        findings.must_break(
            f"{label}, mu_s = {steep:g}: rate / sqrt(g D^3) over the reference's",
            rate / REFERENCE[steep],
            low=0.92,
            high=1.08,
        )


def silo_rate(cells: int, mu: float, *, plate: float = JET, **tables: TableValue) -> float:
    """Return rate / sqrt(g D^3) of sand that leaves a silo through a slot in its floor.

    Args:
        cells: cells of the slot, an even number.
        mu: mu_s.
        plate: thickness of the floor [cells].
        tables: further tables of the scene; `friction` replaces mu(I).
    """
    dx = SPACING
    slot, top = cells * dx, JET * dx
    # The slot's sides are faces of the grid if their numbers of cells are even.
    width, fill = 2 * round(0.5 * BASIN * cells) * dx, round(FILLED * cells) * dx
    left, right = 0.5 * (width - slot), 0.5 * (width + slot)
    low = top - plate * dx
    solids = [
        box([-1.0, low], [left, top], friction="stick"),
        box([right, low], [width + 1.0, top], friction="stick"),
    ]

    def angle(tangent: float) -> float:
        return math.degrees(math.atan(tangent))

    scene: Tables = CORRECTED | {
        "material": {
            "friction_angle": angle(mu),
            "friction_angle_test": "simple-shear",
            "max_fraction": 0.6,
        },
        # I of the reference has the density of the bulk, ours that of grains.
        "friction": {
            "dynamic_angle": angle(mu + GROWTH),
            "inertial_number": INERTIAL_NUMBER,
            "grain_size": GRAIN * slot * math.sqrt(0.6),
        },
    }
    size = [width, top + fill + 4.0 * dx]
    simulation = create_sand(
        size,
        round(max(size) / dx),
        [box([0.0, top], [width, top + fill])],
        solids,
        walls="stick",
        drain=[box([-1.0, -1.0], [width + 1.0, top])],
        **(scene | tables),
    )
    area = simulation.particle_mass / simulation.scene.physics.density
    unit, time, left_over = math.sqrt(slot / GRAVITY), [0.0], [simulation.particles.count]
    for row in steps(simulation, OUTFLOW[1] * unit):
        time.append(row["time"])
        left_over.append(simulation.particles.count)
    first, last = np.interp(np.array(OUTFLOW) * unit, time, left_over)
    return float((first - last) * area / (np.ptp(OUTFLOW) * unit)) / math.sqrt(GRAVITY * slot**3)


def _empty(
    simulation: scenes.Simulation, area: float, low: float, rows: list[Row]
) -> tuple[np.ndarray, np.ndarray]:
    """Step until a bin's fill is `low` [widths]; return times [s] and areas [m^2].

    The area is that of the material in the bin. The rows of the log are appended to `rows`.
    """
    time, left = [0.0], [simulation.particles.count]
    while left[-1] * area > low * WIDTH**2:
        rows += steps(
            simulation, simulation.time + min(simulation.stable_dt(), simulation.scene.time.dt_max)
        )
        time.append(simulation.time)
        left.append(int(np.count_nonzero(positions(simulation)[:, 1] > BELOW + PLATE * SPACING)))
    return np.array(time), np.array(left) * area


def _bin(slot: float, depth: float) -> tuple[list[float], list[Tables], Tables, Tables]:
    """Return the scene of a bin.

    It has the size of the domain, the halves of the floor, the fill, and a drain below.
    """
    top = BELOW + PLATE * SPACING
    size = [WIDTH, top + depth + 4.0 * SPACING]
    left, right = 0.5 * (WIDTH - slot), 0.5 * (WIDTH + slot)
    solids = [box([-1.0, BELOW], [left, top]), box([right, BELOW], [WIDTH + 1.0, top])]
    return (
        size,
        solids,
        box([0.0, top], [WIDTH, top + depth]),
        box([-1.0, -1.0], [WIDTH + 1.0, 2.0 / 3.0 * BELOW]),
    )


def _rates(
    time: np.ndarray, area: np.ndarray, first: float, last: float, parts: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return centers [widths] and rates [m^2/s] of the parts of a range of fills."""
    ends = np.linspace(first, last, parts + 1)
    at = np.interp(-ends * WIDTH**2, -area, time)
    return 0.5 * (ends[1:] + ends[:-1]), -np.diff(ends) * WIDTH**2 / np.diff(at)


def _law(trials: Sequence[ValidationTrial]) -> RecordLines:
    laws: Tables = {t.resolution: t.curves["law"] for t in trials if "law" in t.curves}
    laws["rate = sqrt(g D^3)"] = ([0.0, 0.09], [0.0, 0.09 * GRAVITY ** (1.0 / 3.0)])
    marked, y = frozenset(t.resolution for t in trials), "(rate)^(2/3) [m^(4/3) / s^(2/3)]"
    return RecordLines(
        "sand-slot", "Discharge over the slot", "D [m]", y, laws, log="", marked=marked
    )


CHECK = ValidationCheck(
    about=__doc__ or "",
    trials=[(trial, tuple(OPENINGS)), (reference, REFERENCE_CELLS)],
    charts=[
        plot(
            "sand-discharge",
            "Discharge of a bin over its fill",
            "fill / width",
            "rate / first rate",
            "D = ",
            "liquid",
        ),
        _law,
        plot(
            "sand-silo-rate",
            "Discharge of a silo over its friction",
            "mu_s",
            "rate / sqrt(g D^3)",
            "rate",
            exact={"Basilisk": (list(REFERENCE), list(REFERENCE.values()))},
            marked=("Basilisk",),
        ),
    ],
    known="deep sand that yields everywhere: with cells of 5 mm 10 % of the steps at the narrowest "
    "slot miss the error, with cells of 2.5 mm 97 %",
)
