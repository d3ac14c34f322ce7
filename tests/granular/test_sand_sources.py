"""Sources and drains of sand, and their log entries."""

from typing import Any

import numpy as np
import pytest

from small_sands import GRAVITY, advance, box, create, scene

TAP = box([0.25, 0.875], [0.5, 1.0], velocity=[0.0, -0.5])


def total(rows: list[dict[str, Any]], name: str) -> int:
    return sum(row[name] for row in rows)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_source_lets_in_area_times_velocity(dimension: int) -> None:
    source = box(
        [0.25, 0.875, 0.25][:dimension],
        [0.5, 1.0, 0.5][:dimension],
        velocity=[0.0, -0.5, 0.0][:dimension],
    )
    simulation = create(
        scene(
            size=[1.0] * dimension,
            resolution=16,
            sand=[],
            source=[source],
            solver={"max_iterations": 60},
        )
    )
    start = simulation.particles.count
    rows = advance(simulation, 0.5)
    let_in = 0.25 ** (dimension - 1) * 0.5 * 0.5 * 16**dimension * 2**dimension
    assert total(rows, "emitted") == pytest.approx(let_in, rel=0.02)
    assert simulation.particles.count == start + total(rows, "emitted")
    assert rows[-1]["mass"] == pytest.approx(
        simulation.particles.count * simulation.particle_mass, rel=1e-12
    )


def test_a_source_that_has_stopped_leaves_no_velocity_behind() -> None:
    """Source that has stopped: no remaining velocity.

    Velocities of the source at the ceiling's faces would push away sand that is held against it.
    """
    source = {**TAP, "stop": 0.05}
    simulation = create(scene(size=[1.0, 1.0], resolution=16, sand=[], source=[source]))
    advance(simulation, 0.1)
    assert all(not field.numpy().any() for field in simulation.solids.velocity)


def test_drained_and_outgoing_mass_equals_the_flow() -> None:
    tables = {"drain": [box([0.0, 0.0], [0.25, 0.0625])], "open": ["right"], "friction": 0.1}
    simulation = create(
        scene(size=[1.0, 0.5], resolution=16, sand=[box([0.0, 0.0], [1.0, 0.25])], **tables)
    )
    start = simulation.particles.count
    rows = advance(simulation, 0.5)
    gone = total(rows, "drained") + total(rows, "departed")
    assert total(rows, "drained") > 0
    assert total(rows, "departed") > 0
    assert start - simulation.particles.count == gone
    assert sum(row["flow_rate"] * row["dt"] for row in rows) == pytest.approx(
        gone * simulation.particle_mass, rel=1e-9
    )


def test_the_gauge_counts_what_falls_through_it() -> None:
    """Gauge of sand that falls through it.

    The whole drop falls through in the end: between the times of its two ends, nothing before and
    nothing after.
    """
    drop = box([0.25, 0.6], [0.5, 0.8])
    simulation = create(scene(size=[1.0, 1.0], resolution=16, sand=[drop], gauge={"height": 0.4}))
    rows = advance(simulation, 0.4)
    mass = simulation.particles.count * simulation.particle_mass
    assert sum(row["flow_rate"] * row["dt"] for row in rows) == pytest.approx(mass, rel=1e-9)
    times = np.cumsum([row["dt"] for row in rows])
    first, last = (2.0 * 0.2 / GRAVITY) ** 0.5, (2.0 * 0.4 / GRAVITY) ** 0.5
    flow = np.array([row["flow_rate"] for row in rows])
    assert not flow[times < 0.7 * first].any()
    assert not flow[times > 1.3 * last].any()


def test_sand_that_fills_its_box_stops_no_run() -> None:
    """Source in a full box does not stop the run.

    Excess sand is packed too densely, and the log says how much.
    """
    source = box([0.25, 0.4375], [0.5, 0.5], velocity=[0.0, -0.5])
    simulation = create(
        scene(size=[0.5, 0.5], resolution=8, sand=[box([0.0, 0.0], [0.5, 0.4375])], source=[source])
    )
    rows = advance(simulation, 0.1)
    assert np.isfinite(rows[-1]["kinetic_energy"])
    assert rows[-1]["max_fraction"] >= 1.0


@pytest.mark.parametrize("tables", [{}, {"particles": {"transfer": "flip"}}])
def test_an_interrupted_pour_goes_on_bit_for_bit(tables: dict[str, Any]) -> None:
    def make() -> Any:
        return create(
            scene(
                size=[1.0, 1.0],
                resolution=16,
                sand=[],
                source=[TAP],
                drain=[box([0.25, 0.0], [0.5, 0.125])],
                **tables,
            )
        )

    through, resumed = make(), make()
    advance(through, 0.4)
    resumed.restore(through.state())
    for _ in range(10):
        dt = through.stable_dt()
        assert resumed.stable_dt() == dt
        assert through.step(dt) == resumed.step(dt)
    a, b = through.state(), resumed.state()
    assert all(np.array_equal(a[name], b[name]) for name in a)
