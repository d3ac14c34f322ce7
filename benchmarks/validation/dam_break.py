"""Collapsing columns of liquid: front and height of a dam break, and volume.

The front and the height are compared with experiments. The volume must stay constant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from warp_lcp.benchmarks.validation import signals
from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at, plot
from warp_lcp.benchmarks.validation.scenes import (
    GRAVITY,
    SUB_CELL,
    NumericalSettings,
    Row,
    box,
    create_liquid,
    fill,
    particles_in_cells,
    steps,
)
from warp_lcp.benchmarks.validation.signals import (
    best_shift,
    enclosed_cells,
    filled_fraction,
    front,
    relative_rms,
    stays,
    surface_height,
)
from warp_lcp.files import TableValue
from warp_lcp.fluids import LiquidSimulation

RESOLUTIONS = (12, 24)  # cells of the column's base a
LIMITS = {12: 5.0, 24: 3.0}  # [%] largest RMS error after the best shift
A = 0.05715  # [m] base of the column
N2 = 2.0
LENGTH, HEIGHT = 6.0, 2.5  # size of the tank, in units of a: the front meets no wall
END = 3.7  # end of the run, in T
MAX_SHIFT = 0.3  # limit of the shift in T, since the time origin of the experiment is uncertain
FIRST, LAST = 0.84, 3.33  # range of T of the compared data
WRONG_GRAVITY = (0.5, 0.8, 1.25, 2.0)  # gravity in the controls, as factors of the true one
TAU_LAST = 2.45

SIZE, COLUMN = [1.6, 0.8], 0.4  # [m] domain with two columns, and the side of each
# [s] length of the run, and the end over which the volume is averaged
DURATION, AVERAGED = 30.0, 2.0
# [s] The same for the column of the dam break, which fills a pool four cells deep.
DAM_DURATION, DAM_AVERAGED = 3.0, 0.3
UNCORRECTED: Row = {"density_correction": {"every": 0}}
# Labels and titles of the charts.
DATA, FRONT, HIGH = "Martin & Moyce", "Front of a collapsing column", "Height at the wall"

# [MartinMoyce1952], front and height of the column of square section, n^2 = 2.
T = np.array(
    [0.41, 0.84, 1.19, 1.43, 1.63, 1.83, 1.98, 2.20, 2.32, 2.51, 2.65, 2.83, 2.98, 3.11, 3.33]
)
Z = np.array(
    [1.11, 1.22, 1.44, 1.67, 1.89, 2.11, 2.33, 2.56, 2.78, 3.00, 3.22, 3.44, 3.67, 3.89, 4.11]
)
TAU = np.array(
    [0.56, 0.77, 0.93, 1.08, 1.28, 1.46, 1.66, 1.84, 2.00, 2.21, 2.45, 2.70, 3.06, 3.44, 4.20, 5.25]
)
H = np.array(
    [0.94, 0.89, 0.83, 0.78, 0.72, 0.67, 0.61, 0.56, 0.50, 0.44, 0.39, 0.33, 0.28, 0.22, 0.17, 0.11]
)

# The same experiment at larger distances, as read off its figure 3 (PySPH's `db_exp_data`), and the
# range in which its slope is compared.
FAR_T = np.array([3.345, 4.034, 4.418, 5.091, 5.685, 6.306, 6.822, 7.439, 8.031, 8.633, 9.237])
FAR_Z = np.array([4.134, 4.944, 5.881, 6.980, 7.945, 8.966, 9.986, 10.963, 11.977, 13.005, 13.970])
# Range of Z; length of the tank in units of a; end of the run in T.
FAR, FAR_LENGTH, FAR_END = (4.0, 14.0), 16.0, 11.0
VISCOSITY = 1e-6  # kinematic viscosity of water [m^2/s]


class DamCollapse(NamedTuple):
    """Collapse in the units of the experiment."""

    T: np.ndarray  # times at which the front is at its places, T = n t sqrt(g / a)
    Z: np.ndarray  # these places, over a
    tau: np.ndarray  # t sqrt(g / a) of every step
    H: np.ndarray  # height beside the wall over n^2 a


@check_at("dam break", "{cells} cells of a, {numerics.name}")
def front_and_height(
    findings: Findings, cells: int, numerics: NumericalSettings = SUB_CELL
) -> None:
    """Compare a collapse with the data.

    The controls have wrong gravity, but their time is measured with the true one.
    """
    limit = LIMITS[cells]
    compared = (T >= FIRST) & (T <= LAST)
    at, expected = T[compared], Z[compared]
    c = collapse(cells, numerics)
    shift, rms = best_shift(c.T, c.Z, at, expected, MAX_SHIFT)
    findings.add(
        "RMS error of Z", 100.0 * relative_rms(c.T, c.Z, at, expected), high=20.0, unit="%"
    )
    findings.add("RMS error of Z after the best shift", 100.0 * rms, high=limit, unit="%")
    findings.add("the best shift of T", shift, low=-MAX_SHIFT, high=MAX_SHIFT)
    findings.add("gravity that the front shows", shown_gravity(c), low=0.9, high=1.1, unit="g")
    early = TAU <= TAU_LAST
    findings.add(
        "largest |dH|", float(np.abs(np.interp(TAU[early], c.tau, c.H) - H[early]).max()), high=0.05
    )
    findings.curve("front", c.T, c.Z)
    findings.curve("height", c.tau, c.H)
    findings.curve(f"front, shifted by {-shift:.2f}", c.T - shift, c.Z)
    for factor in WRONG_GRAVITY:
        wrong = collapse(cells, numerics, gravity=factor * GRAVITY)
        findings.must_break(
            f"{factor:g} g: gravity that the front shows",
            shown_gravity(wrong),
            low=0.9,
            high=1.1,
            unit="g",
        )
        if factor == min(WRONG_GRAVITY):  # a shift can hide the error of nearer ones
            rms = 100.0 * best_shift(wrong.T, wrong.Z, at, expected, MAX_SHIFT)[1]
            findings.must_break(
                f"{factor:g} g: RMS error of Z after the best shift", rms, high=limit, unit="%"
            )


def shown_gravity(c: DamCollapse) -> float:
    """Return the gravity inferred from a collapse's front, over the true one.

    It is the gravity with which the experiment's front would be as fast as the collapse's. Times
    scale with 1 / sqrt(g), and the time origin of the experiment is uncertain. The speed of the
    even part alone is not enough: it scales with sqrt(g) too, but data and simulation leave a range
    as wide as that from 0.8 g to 1.25 g.
    """
    compared = (T >= FIRST) & (T <= LAST)
    return signals.best_pace(c.T, c.Z, T[compared], Z[compared], MAX_SHIFT) ** 2


def slope(time: np.ndarray, place: np.ndarray) -> float:
    """Return the speed of a front far from its start, dZ/dT."""
    far = (place >= FAR[0]) & (place <= FAR[1])
    return float(np.polyfit(time[far], place[far], 1)[0])


def plate_friction() -> float:
    """Return the friction coefficient c_f of a smooth plate, 0.074 Re^(-1/5).

    Prandtl's law for turbulent flow is used, for a plate of length 10 a at the speed of the
    experiment's front.
    """
    speed = slope(FAR_T, FAR_Z) * math.sqrt(N2 * GRAVITY * A)
    return 0.074 * (speed * 10.0 * A / VISCOSITY) ** -0.2


@check_at("dam break with drag", "{cells} cells of a, {numerics.name}")
def far_front(findings: Findings, cells: int, numerics: NumericalSettings = SUB_CELL) -> None:
    """Compare the speed of the front at large distances.

    A floor without drag lets it run too fast; the control has no drag.
    """
    expected = slope(FAR_T, FAR_Z)
    for label, tables in (
        ("c_f of a smooth plate", {"wall_drag": {"coefficient": plate_friction()}}),
        ("no drag", {}),
    ):
        simulation = create(cells, numerics, FAR_LENGTH, **tables)
        unit = math.sqrt(N2 * GRAVITY / A)
        run = [
            (unit * row["time"], front(fill(simulation)) / cells)
            for row in steps(simulation, FAR_END / unit)
        ]
        time, place = stays(*np.array(run).T)
        judge = findings.add if tables else findings.must_break
        judge(
            f"{label}: dZ/dT over the experiment's, Z from 4 to 14",
            slope(time, place) / expected,
            low=0.95,
            high=1.05,
        )
        findings.curve(label, time, place)


def create(
    cells: int, numerics: NumericalSettings, length: float = LENGTH, **tables: TableValue
) -> LiquidSimulation:
    """Return a column on a free-slip floor in a tank.

    Its base has `cells` cells. `length` is that of the tank, in units of the base.
    """
    column = box([0.0, 0.0], [A, N2 * A])
    return create_liquid(
        numerics, [length * A, HEIGHT * A], round(length * cells), [column], **tables
    )


def collapse(cells: int, numerics: NumericalSettings, *, gravity: float = GRAVITY) -> DamCollapse:
    """Simulate a collapse.

    T and tau are measured with the true gravity, whatever `gravity` [m/s^2] is.
    """
    simulation = create(cells, numerics, physics={"gravity": [0.0, -gravity]})

    def now(time: float) -> tuple[float, float, float]:
        """Return the time [s], the front, and the surface height at the left wall [cells]."""
        wall = filled_fraction(*particles_in_cells(simulation))[:, 0]
        return time, front(fill(simulation)), surface_height(wall)

    unit = math.sqrt(GRAVITY / A)
    time, place, height = np.array(
        [now(0.0), *(now(row["time"]) for row in steps(simulation, END / (math.sqrt(N2) * unit)))]
    ).T
    tau = unit * time
    return DamCollapse(*stays(math.sqrt(N2) * tau, place / cells), tau, height / (N2 * cells))


DAM_BREAK = ValidationCheck(
    about="A dam break against the experiments of Martin & Moyce 1952: a column of base a and "
    "height n^2 a, n^2 = 2.",
    trials=[(front_and_height, RESOLUTIONS), (far_front, RESOLUTIONS)],
    charts=[
        plot(
            "dam-break-front",
            FRONT,
            "T = n t sqrt(g / a)",
            "Z = x / a",
            "front",
            exact={DATA: (T, Z)},
            marked=[DATA],
        ),
        plot(
            "dam-break-drag",
            FRONT,
            "T = n t sqrt(g / a)",
            "Z = x / a",
            "c_f of a smooth plate",
            exact={DATA: (FAR_T, FAR_Z)},
            marked=[DATA],
        ),
        plot(
            "dam-break-height",
            HIGH,
            "tau = t sqrt(g / a)",
            "H = y / (n^2 a)",
            "height",
            exact={DATA: (TAU, H)},
            marked=[DATA],
        ),
    ],
)


@check_at("volume", "{resolution} cells, {numerics.name}")
def columns(findings: Findings, resolution: int, numerics: NumericalSettings = SUB_CELL) -> None:
    """Compare the volume inside the surface with the one at the start.

    The control has no density correction; otherwise it is on by default.
    """
    right = box([SIZE[0] - COLUMN, 0.0], [SIZE[0], COLUMN])
    late = []
    for label, tables in (("as it comes", {}), ("no correction", UNCORRECTED)):
        simulation = create_liquid(
            numerics, SIZE, resolution, [box([0.0, 0.0], [COLUMN, COLUMN]), right], **tables
        )
        time, volume, density = watch(simulation, DURATION)
        late.append(volume[time > DURATION - AVERAGED].mean())
        findings.curve(label, time, volume)
        if not tables:
            findings.add(
                "volume of the last 2 s over that at the start", late[0], low=0.98, high=1.02
            )
            # The correction ignores crowding in single cells; it acts only if a thousandth of the
            # liquid is too dense.
            findings.add("mean of the largest densities", density.mean(), high=1.5)
    findings.must_break(
        "no correction: volume of the last 2 s over that at the start", late[1], low=0.8
    )


@check_at("volume of the dam break", "{cells} cells of a, {numerics.name}")
def dam(findings: Findings, cells: int, numerics: NumericalSettings = SUB_CELL) -> None:
    """Compare the volume of Martin & Moyce's column with its initial volume.

    It has then come to the far wall and back. The control has no density correction.
    """
    for name, tables in (("", {}), ("no correction: ", UNCORRECTED)):
        time, volume, _ = watch(create(cells, numerics, **tables), DAM_DURATION)
        judge = findings.must_break if tables else findings.add
        late = volume[time > DAM_DURATION - DAM_AVERAGED].mean()
        judge(f"{name}volume of the last .3 s over that at the start", late, low=0.98, high=1.02)


def watch(
    simulation: LiquidSimulation, duration: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times [s], relative volumes and largest densities of the steps.

    Times are the ends of the steps. Volumes are those inside the surface, over that at the start.
    Largest densities are given if known. The surface is reconstructed independently of the
    simulation, since a count of particles could not show a loss of volume.
    """

    def volume() -> float:
        return enclosed_cells(*particles_in_cells(simulation))

    before = volume()
    rows = [
        (row["time"], volume() / before, row.get("max_density", np.nan))
        for row in steps(simulation, duration)
    ]
    time, volumes, density = np.array(rows).T
    return time, volumes, density


VOLUME = ValidationCheck(
    about="Columns that collapse keep their volume: two into each other for half a minute, those "
    "of the experiments for three seconds.",
    trials=[(columns, (64, 96)), (dam, RESOLUTIONS)],
    charts=[plot("volume", "Volume of two columns that collapse", "t [s]", "volume / start")],
)
