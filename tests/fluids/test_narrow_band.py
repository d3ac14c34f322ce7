"""Narrow band: liquid whose particles are near its surface only."""

import math
from typing import Any

import numpy as np
import pytest
import warp as wp
from pydantic import ValidationError

from default_run import chosen, covering
from grid_fields import particles_of_cells
from small_liquids import GRAVITY, advance, box, create, scene
from warp_lcp.fluids import LiquidScene, LiquidSimulation
from warp_lcp.granular.scene import SandScene
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.narrow_band import NarrowBand
from warp_lcp.operators.grid_poisson import FLUID, SOLID

WIDTH = 4.0
BAND = {"narrow_band": {"width": WIDTH}}


def tank(
    dimension: int = 2, resolution: int = 32, height: float = 0.75, **tables: Any
) -> LiquidSimulation:
    """Return a tank of liquid at rest, a cube or square whose upper part is air."""
    size = [1.0, 1.0, 0.5][:dimension]
    liquid = tables.pop("liquid", [box([0.0] * dimension, [1.0, height, 0.5][:dimension])])
    particles = tables.pop("particles", BAND)
    return create(
        scene(size=size, resolution=resolution, liquid=liquid, particles=particles, **tables)
    )


def without(simulation: LiquidSimulation) -> NarrowBand:
    """Return the band, which must exist."""
    assert simulation.band is not None
    return simulation.band


@pytest.mark.parametrize("dimension", [2, 3])
def test_particles_are_near_the_surface_only(dimension):
    """Particles near the surface only.

    24 rows of liquid, the surface between two rows: four hold all their particles, twenty none, and
    nothing is missing.
    """
    simulation, everywhere = tank(dimension), tank(dimension, particles={})
    band = without(simulation)
    rows = particles_of_cells(simulation.grid, simulation.particles).sum(axis=(0, 2))
    full = particles_of_cells(everywhere.grid, everywhere.particles).sum(axis=(0, 2))
    assert np.array_equal(rows[20:24], full[20:24]) and not rows[:20].any()
    assert band.held == full[:20].sum() and band.interior.count == band.held // 2**dimension
    before, after = everywhere.checked_totals("at"), simulation.checked_totals("at")
    assert after.count == before.count and np.allclose(after.center, before.center, atol=1e-4)
    assert simulation.surface.volume(0) == pytest.approx(everywhere.surface.volume(0), rel=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_particles_below_the_band_are_around_solids_inside_only(dimension):
    """Particles below the band around inner solids, not along the domain's walls.

    Whichever side of the walls they are on.
    """
    center, radius = np.array([0.5, 0.3, 0.25])[:dimension], 0.08
    simulation = tank(
        dimension, solid=[{"shape": "sphere", "center": center.tolist(), "radius": radius}]
    )
    assert simulation.boundary.distance is not None
    held = (
        np.argwhere(particles_of_cells(simulation.grid, simulation.particles)[:, :19] > 0)[:, ::-1][
            :, :dimension
        ]
        + 0.5
    ) / 32
    gap = 32 * (np.linalg.norm(held - center, axis=1) - radius)
    assert 4.0 < gap.max() < 1.0 + WIDTH + 1.0


def test_without_the_table_there_is_no_band():
    """Without the table no field, no column, no entry of the state."""
    simulation = tank(particles={})
    assert simulation.band is None
    assert not {"depth", "interior", "interior_velocity_0"} & simulation.state().keys()


def test_the_depth_is_a_distance():
    """Depth as a distance.

    It is exact below a plane, and within 8 % below a corner of air. Solids do not change it.
    """
    grid = StaggeredGrid((24, 24, 1), 1.0, 2, "cpu")
    simulation = tank(2, 24, 1.0, solid=[box([0.25, 0.25], [0.5, 0.5])], solids="voxel")
    band = NarrowBand(
        grid, simulation.boundary, width=12.0, per_axis=2, jitter=0.25, random_seed=77
    )
    kind = simulation.boundary.base.numpy()
    kind[1, 1:21, 1:25] = np.where(kind[1, 1:21, 1:25] == SOLID, SOLID, FLUID)
    band._measure(grid.everywhere, wp.array(kind, device="cpu"), None, grid.field(wp.uint8))
    depth = band._now.numpy()[1]
    assert np.allclose(depth[1:21, 1:25], np.minimum(20.5 - np.arange(1, 21), 15.0)[:, None])
    kind[1, 1:21, 1:25] = np.where(kind[1, 1:21, 1:25] == SOLID, SOLID, FLUID)
    kind[1, 21:25, 1:12] = FLUID  # air is a box in the upper right corner
    band._measure(grid.everywhere, wp.array(kind, device="cpu"), None, grid.field(wp.uint8))
    y, x = np.meshgrid(np.arange(26.0), np.arange(26.0), indexing="ij")
    exact = np.hypot(np.maximum(12.0 - x, 0.0), np.maximum(21.0 - y, 0.0))
    found = (band._now.numpy()[1] + 0.5)[1:25, 1:25]
    far = (found < 12.0) & (exact[1:25, 1:25] > 1.0)
    assert np.abs(found[far] / exact[1:25, 1:25][far] - 1.0).max() < 0.083


def test_rest_stays_rest():
    """Liquid at rest.

    Particles come and go at the band's inner edge; nothing else moves, and mass and volume stay.
    """
    simulation = tank()
    start = simulation.checked_totals("at").count
    rows = advance(simulation, 1.0)
    assert rows[-1]["volume"] == pytest.approx(0.75, rel=2e-3)
    assert rows[-1]["max_speed"] < 0.1 * math.sqrt(GRAVITY / 32)
    assert rows[-1]["mass"] / simulation.particle_mass == pytest.approx(start, abs=1e-6)
    held = particles_of_cells(simulation.grid, simulation.particles)[0]
    assert held[20:23].min() >= 1
    assert not held[:19].any()
    assert without(simulation).density == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_block_in_free_flight_keeps_its_shape(dimension):
    """Shape of a block in free flight.

    Uniform translation across cells: depth and velocity move along, the volume stays, and no hole
    opens.
    """
    low, high = [0.08, 0.3, 0.05][:dimension], [0.58, 0.8, 0.45][:dimension]
    speed = [0.7, 0.9, 0.1][:dimension]
    start = {
        "liquid": [box(low, high, velocity=speed)],
        "resolution": 48,
        "physics": {"gravity": [0.0] * dimension},
    }
    simulation = tank(dimension, **start)
    band = without(simulation)
    cells, volume = band.interior.count, simulation.surface.volume(0)
    assert cells > 0
    for _ in range(12):
        row = simulation.step(0.01)
    moved = np.array([0.12 * s for s in (*speed, 0.0)[:3]])
    assert row["volume"] == pytest.approx(volume, rel=0.01)
    assert band.interior.count == pytest.approx(cells, rel=0.12)
    middle = 0.5 * np.array([*np.add(low, high), 0.0][:3]) + moved
    assert np.allclose(band.interior.center, middle, atol=0.5 / 48)  # of whole cells
    assert row["max_speed"] == pytest.approx(np.linalg.norm(speed), rel=2e-3)
    assert row["kinetic_energy"] == pytest.approx(
        0.5 * row["mass"] * np.linalg.norm(speed) ** 2, rel=2e-3
    )
    simulation.mark()
    centers = (
        np.argwhere(simulation.projection.kind.numpy()[1:-1, 1:-1, 1:-1] == FLUID)[:, ::-1] + 0.5
    ) / 48
    depth = np.linalg.norm((centers - middle)[:, :dimension], axis=1)
    filled = np.count_nonzero(depth < 0.15)
    ball = 48**dimension * 0.15**dimension * (math.pi if dimension == 2 else 4.0 / 3.0 * math.pi)
    assert filled == pytest.approx(ball, rel=0.05)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("dimension", [2, 3])
def test_liquid_separates_from_a_ceiling(dimension):
    """Separation of a block from a ceiling.

    A new surface opens where there were no particles: the block falls as one and keeps its volume.
    """
    low, high = [0.2, 0.5, 0.05][:dimension], [0.8, 1.0, 0.45][:dimension]
    simulation = tank(dimension, 40, liquid=[box(low, high)])
    volume = simulation.surface.volume(0)
    assert without(simulation).interior.count > 0
    rows = advance(simulation, 0.2)
    assert rows[-1]["max_speed"] == pytest.approx(
        GRAVITY * (0.2 - 0.5 * simulation.last_dt), rel=1e-3
    )
    assert rows[-1]["kinetic_energy"] == pytest.approx(
        0.5 * rows[-1]["mass"] * (GRAVITY * 0.2) ** 2, rel=1e-3
    )
    assert rows[-1]["volume"] == pytest.approx(volume, rel=0.01)
    reference = advance(tank(dimension, 40, liquid=[box(low, high)], particles={}), 0.2)
    # Of whole cells.
    assert rows[-1]["center_of_mass_y"] == pytest.approx(
        reference[-1]["center_of_mass_y"], abs=0.25 / 40
    )


def test_a_body_dives_into_the_interior():
    """Body that dives into the interior.

    Particles are around a solid before it arrives; none is lost, and the liquid keeps its volume.
    """
    plunge = {"kind": "translation", "velocity": [0.0, -1.0]}
    particles = {"transfer": "apic", **BAND}
    disk = {"shape": "sphere", "center": [0.5, 0.92], "radius": 0.06, "motion": plunge}
    simulation, other = (
        tank(2, 48, solid=[disk], particles=p, density_correction={}) for p in (particles, {})
    )
    rows, reference = advance(simulation, 0.5), advance(other, 0.5)
    assert without(simulation).interior.count > 0
    assert rows[-1]["mass"] == reference[-1]["mass"]
    assert rows[-1]["volume"] == pytest.approx(reference[-1]["volume"], rel=0.01)
    near = np.hypot(*(simulation.particles.position.numpy()[:, :2] - [0.5, 0.42]).T)
    all_of_them = np.hypot(*(other.particles.position.numpy()[:, :2] - [0.5, 0.42]).T)
    ring = [
        np.count_nonzero((distance > 0.06) & (distance < 0.06 + 2.0 / 48))
        for distance in (near, all_of_them)
    ]
    assert ring[0] == pytest.approx(ring[1], rel=0.15)


def sloshing(particles: dict[str, Any], end: float) -> list[dict[str, Any]]:
    """Return the log of a standing wave.

    The wave is half a wavelength in a tank 1 m wide and 0.5 m deep.
    """
    n = 64
    columns = [
        box([i / n, 0.0], [(i + 1) / n, 0.5 + 0.04 * math.cos(math.pi * (i + 0.5) / n)])
        for i in range(n)
    ]
    simulation = create(
        scene(size=[1.0, 0.75], resolution=n, liquid=columns, wall="free-slip", particles=particles)
    )
    return advance(simulation, end)


def wave(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Return a standing wave's period [s] and decay [1/s].

    They follow from the peaks of its kinetic energy.
    """
    time, energy = (
        np.cumsum([row["dt"] for row in rows]),
        np.array([row["kinetic_energy"] for row in rows]),
    )
    peaks: list[tuple[float, float]] = []
    for i in range(1, len(time) - 1):
        if energy[i] >= max(energy[i - 1], energy[i + 1], 0.5 * energy.max()) and (
            not peaks or time[i] - peaks[-1][0] > 0.3
        ):
            a, b, c = np.polyfit(time[i - 1 : i + 2] - time[i], energy[i - 1 : i + 2], 2)
            peaks.append((time[i] - 0.5 * b / a, c - 0.25 * b * b / a))
    times, heights = np.array(peaks).T
    return 2.0 * float(np.diff(times).mean()), -float(np.polyfit(times, np.log(heights), 1)[0])


@pytest.mark.slow
def test_a_band_does_not_change_speed_and_damping_of_a_wave():
    """Speed and damping of a wave.

    The period is that of linear theory within 1 %, and that of particles everywhere within 0.2 %,
    without additional damping.
    """
    period, decay = wave(sloshing(BAND, 3.5))
    reference, other = wave(sloshing({}, 3.5))
    assert period == pytest.approx(
        2.0 * math.pi / math.sqrt(GRAVITY * math.pi * math.tanh(0.5 * math.pi)), rel=0.01
    )
    assert period == pytest.approx(reference, rel=2e-3)
    assert -0.002 < decay < other + 0.005


def dams(
    particles: dict[str, Any], end: float, resolution: int = 64, **tables: Any
) -> tuple[LiquidSimulation, list[dict[str, Any]]]:
    """Return two dams that break against each other, and the log."""
    liquid = [box([0.0, 0.0], [0.3, 0.7]), box([0.7, 0.0], [1.0, 0.7])]
    model = scene(
        size=[1.0, 1.0],
        resolution=resolution,
        liquid=liquid,
        particles=particles,
        density_correction={},
        **tables,
    )
    simulation = create(model)
    return simulation, advance(simulation, end)


def volumes(rows: list[dict[str, Any]], times: np.ndarray) -> np.ndarray:
    """Return a log's volume at some times."""
    return np.interp(times, np.cumsum([row["dt"] for row in rows]), [row["volume"] for row in rows])


def test_a_splash_keeps_mass_and_volume():
    """Mass and volume of a splash.

    Waves break and enclose air: the mass is exact, the volume that of particles everywhere, with a
    third of them.
    """
    simulation, rows = dams(BAND, 1.0)
    other, reference = dams({}, 1.0)
    assert {row["mass"] for row in rows} == {reference[0]["mass"]}
    times = np.linspace(0.05, 0.95, 100)
    volume, expected = (volumes(log, times) for log in (rows, reference))
    assert np.abs(volume / expected - 1.0).max() < 0.03
    assert np.mean([row["particles"] for row in rows]) < 0.33 * other.particles.count
    assert abs(without(simulation).density - 1.0) < 0.05
    assert rows[-1]["particles"] == simulation.particles.count


@pytest.mark.slow
def test_volume_stays_for_long():
    """Volume of two dams over thirty seconds.

    Within 1.5 % of particles everywhere, and nearer to the volume at the start.
    """
    _, rows = dams(BAND, 30.0, 100)
    _, reference = dams({}, 30.0, 100)
    times = np.linspace(0.05, 29.9, 2000)
    volume, expected = (volumes(log, times) for log in (rows, reference))
    assert np.abs(volume / expected - 1.0).max() < 0.015
    assert np.abs(volume[times > 2.0] / 0.42 - 1.0).max() < 0.01


SWAY = {"kind": "sinusoid", "amplitude": [0.1, 0.0], "period": 0.5}
MODELS: list[dict[str, Any]] = [
    {},
    {"particles": BAND | {"transfer": "flip"}},
    {"particles": BAND | {"transfer": "pic", "reseed": {}}},
    {
        "solid": [
            {
                "shape": "sphere",
                "center": [0.5, 0.1],
                "radius": 0.06,
                "motion": {"kind": "sinusoid", "amplitude": [0.1, 0.0], "period": 0.5},
            }
        ]
    },
    {
        "source": [box([0.4, 0.1], [0.45, 0.2], velocity=[1.0, 0.0])],
        "drain": [box([0.6, 0.0], [0.7, 0.05])],
    },
]


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(
    "tables", chosen(MODELS, MODELS[:3:2]), ids=["apic", "flip", "pic", "moving", "sources"]
)
def test_a_run_goes_on_as_if_it_had_not_stopped(tables):
    """Resumed runs, equal bit for bit, including the carried fields."""
    tables = dict(tables)
    particles = tables.pop("particles", BAND)
    simulation, rows = dams(particles, 0.5, **tables)
    assert without(simulation).interior.count > 0
    assert not any(row.get("stuck") for row in rows)
    twin, _ = dams(particles, 0.0, **tables)
    twin.restore(simulation.state())
    for _ in range(9):
        dt = simulation.stable_dt()
        assert twin.stable_dt() == dt
        assert simulation.step(dt) == twin.step(dt)
    first, second = simulation.state(), twin.state()
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_a_dam_at_one_side_keeps_its_volume_and_goes_on_bit_for_bit():
    """Its window changes from step to step, and the surface clears the cells it has left."""
    model = scene(
        size=[1.0, 0.75],
        resolution=40,
        liquid=[box([0.0, 0.0], [0.4, 0.6])],
        particles={"narrow_band": {"width": 4.0}},
    )
    simulation = create(model)
    rows = advance(simulation, 0.3)
    assert rows[-1]["volume"] == pytest.approx(0.24, rel=0.03)
    twin = create(model)
    twin.restore(simulation.state())
    for _ in range(3):
        dt = simulation.stable_dt()
        assert simulation.step(dt) == twin.step(dt)


def test_a_state_belongs_to_its_band():
    """Refusal of a state for another band.

    A band of another width, or none, would lack particles.
    """
    state = tank().state()
    with pytest.raises(ValueError, match=r"narrow band is 4 cells wide: this scene's is 6"):
        tank(particles={"narrow_band": {"width": 6.0}}).restore(state)
    with pytest.raises(ValueError, match=r"this scene has no particles\.narrow_band"):
        tank(particles={}).restore(state)
    with pytest.raises(ValueError, match="lacks depth, interior"):
        tank().restore(tank(particles={}).state())


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(("resolution", "particles"), covering([24, 40], [BAND, {}]), ids=str)
def test_another_resolution(resolution, particles):
    """Transfer to another resolution.

    The interior gets its particles back first, so that nothing is lost, whatever the band of the
    new grid.
    """
    start, _ = dams(BAND, 0.4)
    mass, energy = (
        start.checked_totals("at").count * start.particle_mass,
        start.checked_totals("at"),
    )
    twin, _ = dams(particles, 0.0, resolution)
    twin.resample(start.state())
    totals = twin.checked_totals("at")
    assert totals.count * twin.particle_mass == pytest.approx(mass, rel=1e-3)
    assert totals.mean_square_speed == pytest.approx(energy.mean_square_speed, rel=0.05)
    assert np.allclose(totals.center, energy.center, atol=0.01)
    before = twin.particles.count
    row = twin.step(0.002)
    assert row["volume"] == pytest.approx(start.surface.volume(0), rel=0.04)
    assert (row["particles"] < before) == bool(particles)


def test_invalid_band_settings_are_refused():
    """Refusals, each with an alternative."""
    with pytest.raises(ValidationError, match=r"greater than or equal to 3"):
        tank(particles={"narrow_band": {"width": 2.99}})
    assert without(tank(particles={"narrow_band": {"width": 3.0}})).width == 3.0
    with pytest.raises(ValidationError, match="may separate anywhere inside"):
        tank(pressure={"model": "unilateral"})
    with pytest.raises(ValidationError, match=r'needs pressure\.surface = "ghost-fluid"'):
        tank(pressure={"surface": "voxel"})
    sand = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 1.0], "resolution": 16},
        "sand": [{**box([0.0, 0.0], [0.5, 0.5]), "friction_angle": 30.0}],
        "particles": BAND,
    }
    with pytest.raises(ValidationError, match="is for liquids only"):
        SandScene.model_validate(sand)
    model = LiquidScene.model_validate(tank().scene.model_dump(exclude_unset=True))
    assert model.particle_estimate(later=False) == 4 * 4 * 32
    assert "narrow band" in model.memory_parts() and "narrow band" in dict(model.plan())
