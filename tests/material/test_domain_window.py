"""Grid window around the material or the whole domain: the same run."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import small_liquids
import small_sands
from default_run import chosen
from warp_lcp.fluids import LiquidScene
from warp_lcp.granular.scene import SandScene
from warp_lcp.grid import active_rows as vicinity
from warp_lcp.grid.particles import ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material import domain_window as module
from warp_lcp.material.domain_window import DomainWindow, carry_over, pace_of
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.scene.scene import MOST_CELLS
from warp_lcp.scene.table import SceneError
from warp_lcp.simulation import SimulationFailed

DOMAIN = StaggeredGrid((200, 96, 64), 0.1, 3, "cpu")
THROWN = {**small_liquids.box([0.2, 1.0], [0.5, 1.3]), "velocity": [3.0, 1.0]}
BALL = {"shape": "sphere", "center": [1.2, 0.6], "radius": 0.2}
SWAY = {"motion": {"kind": "sinusoid", "amplitude": [0.1, 0.0], "period": 0.5}}
TURN = {"motion": {"kind": "rotation", "rate": 400.0, "center": [0.8, 1.0]}}
SOURCE = {"source": [small_liquids.box([0.9, 1.0], [1.0, 1.1], velocity=[2.0, 0.0], stop=0.1)]}
LIQUIDS: dict[str, dict[str, Any]] = {
    "apic": {},
    "flip": {"particles": {"transfer": "flip"}},
    "band": {
        "particles": {"narrow_band": {"width": 3}},
        "liquid": [{**small_liquids.box([0.2, 0.5], [1.0, 1.3]), "velocity": [3.0, 1.0]}],
    },
    "reseeding": {"particles": {"reseed": {"every": 3}}},
    "correction": {"density_correction": {"every": 2}},
    "unilateral": {"pressure": {"model": "unilateral"}},
    "voxel surface": {"pressure": {"surface": "voxel"}},
    "solid": {"solid": [BALL]},
    "voxel solid": {"solid": [BALL], "solids": "voxel"},
    "moving solid": {"solid": [BALL | SWAY]},
    "turning solid": {"solid": [small_liquids.box([0.55, 0.95], [1.05, 1.05], **TURN)]},
    "body": {"solid": [BALL | {"density": 300.0}]},
    "viscous": {"viscosity": {"value": 30.0}, "solid": [BALL], "domain": {"wall": "sticky"}},
    "surface tension": {"surface_tension": {"coefficient": 0.5}, "solid": [BALL]},
    "wall drag": {"wall_drag": {"coefficient": 0.5}, "solid": [BALL]},
    "source": SOURCE,
    "drain": {"drain": [small_liquids.box([0.8, 0.5], [1.2, 1.0])]},
}
SANDS: dict[str, dict[str, Any]] = {
    "sand": {},
    "solid in sand": {"solid": [BALL]},
    "sand source": {"source": SOURCE["source"]},
}
CASES = [*LIQUIDS, *SANDS]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use grid windows even in small domains, and rebuild them often."""
    for name, value in {"LEAST_CELLS": 0, "MOST": 1.0, "ALIGNED": 8, "SPARE": 1}.items():
        monkeypatch.setattr(module, name, value)


def made(name: str, *, follow: bool) -> ParticleSimulation:
    tables: dict[str, Any] = {"liquid" if name in LIQUIDS else "sand": [THROWN]} | (
        LIQUIDS | SANDS
    )[name]
    short = {key: tables.pop(key) for key in ("solids",) if key in tables}
    domain = (
        {"size": [3.0, 1.5], "resolution": 60, "follow": follow} | short | tables.pop("domain", {})
    )
    data = {"time": {"duration": 10.0}, "domain": domain} | tables
    if name in LIQUIDS:
        return small_liquids.create(
            LiquidScene.model_validate({"scene": {"simulator": "fluids"}} | data)
        )
    return small_sands.create(SandScene.model_validate({"scene": {"simulator": "granular"}} | data))


def run(simulation: ParticleSimulation, steps: int) -> list[Mapping[str, Any]]:
    return [simulation.step(0.008 if n % 3 else 0.004) for n in range(steps)]


@pytest.mark.default_cases(4)
@pytest.mark.parametrize("name", chosen(CASES, CASES[::3]))
def test_a_moving_window_has_the_results_of_the_whole_domain(name: str, small: None) -> None:
    """Moving window against a grid of the domain.

    Sums have another order on grids of other sizes, and coarse levels of the solver may differ:
    results are equal up to rounding, not bit for bit.
    """
    part, whole, grids = made(name, follow=True), made(name, follow=False), set()
    for n in range(24):
        dt = 0.008 if n % 3 else 0.004
        row, expected = part.step(dt), whole.step(dt)
        grids.add((part.grid.origin, part.grid.counts))
        assert row["particles"] == expected["particles"]
        assert row["kinetic_energy"] == pytest.approx(expected["kinetic_energy"], rel=1e-3)
        assert row["center_of_mass_y"] == pytest.approx(expected["center_of_mass_y"], rel=1e-4)
    assert part.grid.whole == whole.grid.counts
    assert part.grid.size < 0.7 * whole.grid.size
    assert len(grids) > 1, "nothing was laid anew"
    cells = part.frame()[1].index  # type: ignore[union-attr]
    assert np.array_equal(np.unique(cells, axis=0), np.unique(whole.frame()[1].index, axis=0))  # type: ignore[union-attr]


@pytest.mark.default_cases(4)
@pytest.mark.parametrize("name", chosen(CASES, CASES[2::3]))
def test_a_moving_window_resumes_bit_for_bit_and_on_the_whole_grid(name: str, small: None) -> None:
    through, later, whole = (
        made(name, follow=True),
        made(name, follow=True),
        made(name, follow=False),
    )
    run(through, 9)
    state = {key: np.array(value) for key, value in through.state().items()}
    assert state["box"].tolist() == [
        list(through.grid.origin),
        (np.array(through.grid.origin) + through.grid.counts).tolist(),
    ]
    later.restore(state)
    whole.restore(state)
    for simulation in (through, later, whole):
        run(simulation, 9)
    found = later.state()
    assert [
        key for key, value in through.state().items() if not np.array_equal(value, found[key])
    ] == []
    assert "box" not in whole.state()
    assert whole.particles.totals().center == pytest.approx(
        through.particles.totals().center, abs=1e-4
    )
    later.restore(whole.state())
    assert later.grid == whole.grid


@pytest.mark.default_cases(4)
@pytest.mark.cpu_form("pieces of rows are the CPU's")
@pytest.mark.parametrize("name", chosen(CASES, CASES[1::3]))
def test_active_rows_leave_the_same_bits(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = made(name, follow=False)
    # Segments end beyond a small box.
    for setting, value in {"LEAST_CELLS": 0, "MOST": 9.0}.items():
        monkeypatch.setattr(vicinity, setting, value)
    part = made(name, follow=False)
    assert run(part, 18) == run(whole, 18)
    found, expected = part.state(), whole.state()
    assert [key for key, value in expected.items() if not np.array_equal(value, found[key])] == []
    if name != "band":  # an interior without particles
        assert part.window(part.particles.totals()).near is not None


@pytest.mark.slow
def test_cost_scales_with_the_material() -> None:
    """Number of cells of the same liquid in 512 times the domain: equal."""
    sizes = []
    for n in (64, 512):
        drop = {"shape": "sphere", "center": [0.05 * n] * 3, "radius": 1.2}
        simulation = small_liquids.create(
            small_liquids.scene(size=[0.1 * n] * 3, resolution=n, liquid=[drop])
        )
        simulation.step(0.004)
        sizes.append(simulation.grid.size)
        state = simulation.state()
        assert state["pressure"].size == simulation.grid.size
    assert sizes[1] <= sizes[0]


def test_grids_are_rebuilt_where_the_material_leaves_them() -> None:
    laid = DomainWindow(DOMAIN)
    first = laid.around([40, 40, 20], [70, 60, 40])
    assert all(low % module.ALIGNED == 0 for low in first.origin)
    moving = laid.around([40, 40, 20], [70, 60, 40], pace=(np.zeros(3), np.array([0.25, 9.0, 0.0])))
    assert moving.covers([40, 40, 20], [74, 68, 40])  # with a margin in the direction of motion
    assert moving.origin == first.origin
    assert laid.around([41, 40, 20], [69, 60, 40], first) is first
    assert (
        laid.around([40, 40, 20], [first.origin[0] + first.counts[0], 60, 40], first) is not first
    )
    assert laid.around([50, 40, 20], [51, 41, 21], first).size < first.size / module.LOOSE
    assert laid.around([0, 0, 0], [150, 90, 60]) is DOMAIN  # more than half of the domain
    # Beyond the domain.
    assert laid.around([-50, 200, 0], [-40, 300, 9]).domain_counts == DOMAIN.counts
    assert DomainWindow(DOMAIN, follows=False).around([40, 40, 20], [41, 41, 21]) is DOMAIN
    always = DomainWindow(DOMAIN, always=(([90, 90, 60], [91, 91, 61]),), endless=[2])
    kept = always.around([40, 40, 20], [50, 50, 30])
    assert kept.covers([40, 40, 0], [91, 91, 63])
    assert laid.at(first.part.where()["box"]) == first
    assert laid.at(None) is DOMAIN
    with pytest.raises(ValueError, match=r"not in this scene's \(200, 96, 64\)"):
        laid.at(np.array([[0, 0, 0], [201, 9, 9]]))


@pytest.mark.parametrize(("max_speed", "apart"), [(2.0, 0.0), (3.0, 2.0)])
def test_a_box_grows_where_its_particles_go(max_speed: float, apart: float) -> None:
    """Growth of a box in cells of 5 cm per step of 0.1 s.

    A mean velocity of 2 m/s down crosses 4 cells at the lower side alone. A particle may be faster
    than the mean in any direction.
    """
    totals = ParticleTotals(count=9, velocity=np.array([0.0, -2.0, 0.0]), max_speed=max_speed)
    low, high = pace_of(totals, 0.1, 0.05)
    np.testing.assert_allclose(low, [apart, 4.0 + apart, apart])
    np.testing.assert_allclose(high, apart)


def test_fields_are_copied_where_old_and_new_grid_overlap() -> None:
    """Transfer of fields where both grids have them, including domain rings."""
    old = StaggeredGrid((32, 96, 64), 0.1, 3, "cpu", origin=(16, 0, 0), whole=DOMAIN.counts)
    new = StaggeredGrid((32, 96, 32), 0.1, 3, "cpu", origin=(32, 0, 16), whole=DOMAIN.counts)
    numbers = np.arange(np.prod(DOMAIN.shape)).reshape(DOMAIN.shape)
    view = tuple(
        slice(o, o + n + 2) for o, n in zip(old.origin[::-1], old.counts[::-1], strict=True)
    )
    found = carry_over(
        {"a": numbers[view], "b": np.array(7)}, old, new, {"a": np.full(new.shape, -1)}
    )["a"]
    assert np.array_equal(found[1:-1, :, 1:17], numbers[17:49, :, 33:49])
    assert (found[:, :, 17:] == -1).all()
    assert (found[0] == -1).all()  # the new grid's own ring


def test_an_unbounded_domain() -> None:
    data = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1.0},
        "liquid": [{**THROWN, "velocity": [40.0, 0.0]}],
    }
    model = LiquidScene
    scene = model.model_validate(
        data | {"domain": {"spacing": 0.05, "dimension": 2, "open": ["left"]}}
    )
    assert scene.cell_counts == (MOST_CELLS, MOST_CELLS, 1)
    assert scene.domain.open == ["left", "right", "top"]
    assert scene.seen[1][0] < 1.0
    assert model.model_validate(scene.model_dump(exclude_none=True)) == scene
    simulation = small_liquids.create(scene)
    while simulation.particles.totals().low[0] < 20.0:
        row = simulation.step(simulation.stable_dt())
    assert simulation.grid.size < 1 << 14
    assert row["kinetic_energy"] == pytest.approx(0.5 * row["mass"] * 1600.0, rel=0.1)
    state = simulation.state()
    state["position"][:, 0] += np.float32(MOST_CELLS * 0.05 - state["position"][:, 0].max() - 0.3)
    simulation.restore(state)
    with pytest.raises(SimulationFailed, match=rf"extends to {MOST_CELLS} cells along x"):
        simulation.step(0.001)
    for wrong, message in (
        (
            {"spacing": 0.05, "size": [1.0, 1.0], "resolution": 16, "dimension": 2},
            "replaces size and resolution",
        ),
        ({"size": [1.0, 1.0], "resolution": 16, "dimension": 2}, "otherwise size gives it"),
        ({"spacing": 0.05, "dimension": 2, "follow": False}, "no grid covers"),
    ):
        with pytest.raises((SceneError, ValueError), match=message):
            model.model_validate(data | {"domain": wrong})
