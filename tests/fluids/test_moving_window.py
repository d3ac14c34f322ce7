"""Moving window: a step visits only the box that the liquid moves through.

The result is that of a step that visits the whole domain.
"""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from small_liquids import box, create, scene
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.grid.staggered import DirtyRegion, StaggeredGrid, Window
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels.launch_graph import LaunchGraph

TABLES: dict[str, dict[str, Any]] = {
    "apic": {},
    "flip": {"particles": {"transfer": "flip"}},
    "diagnostics": {"output": {"diagnostics": True}},
    "source": {
        "source": [
            {
                "shape": "box",
                "min": [1.5, 0.2],
                "max": [1.6, 0.3],
                "velocity": [1.0, 0.5],
                "stop": 0.05,
            }
        ]
    },
    "voxel": {"pressure": {"surface": "voxel"}},
}


def thrown(tables: dict[str, Any], resolution: int = 64, width: float = 2.0) -> LiquidSimulation:
    """Return a block of liquid that flies through a wide domain."""
    block = {**box([0.1, 0.5], [0.3, 0.7]), "velocity": [6.0, 0.0]}
    return create(scene(size=[width, 1.0], resolution=resolution, liquid=[block], **tables))


def states(tables: dict[str, Any]) -> list[dict[str, bytes]]:
    simulation, found = thrown(tables), []
    for _ in range(25):
        row = simulation.step(0.01)
        state = {
            name: np.ascontiguousarray(array).tobytes()
            for name, array in simulation.state().items()
        }
        found.append(state | {"row": repr(sorted(row.items())).encode()})
    return found


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("tables", TABLES.values(), ids=TABLES)
def test_kernels_on_windows_have_the_results_of_kernels_on_all_cells(tables, monkeypatch):
    found = states(tables)
    monkeypatch.setattr(DirtyRegion, "through", lambda self, window: self.all)
    for step, (state, expected) in enumerate(zip(found, states(tables), strict=True)):
        assert [name for name in expected if state[name] != expected[name]] == [], step


def test_cost_of_pressure_and_fragments_scales_with_the_liquid(monkeypatch):
    """Visited cells of passes in a domain eight times as wide."""
    visited = [Counter[str]()]
    run, launch = Window.run, WindowReduction.launch
    # Launches at once, each of which reports the cells that it visits.
    monkeypatch.setattr(
        LaunchGraph, "run", lambda graph, *arguments, variant=None: graph._record(*arguments)
    )

    def count(passed: Any, window: Window) -> None:
        visited[-1][passed.name.rpartition(".")[2]] += int(
            np.prod(np.subtract(window.high, window.low))
        )

    def counted(window: Window, passed: Any, *structs: Any, **given: Any) -> None:
        count(passed, window)
        run(window, passed, *structs, **given)

    def tallied(tally: WindowReduction, window: Window, *structs: Any, **given: Any) -> None:
        count(tally, window)
        launch(tally, window, *structs, **given)

    monkeypatch.setattr(Window, "run", counted)
    monkeypatch.setattr(WindowReduction, "launch", tallied)
    for width in (1.0, 8.0):
        simulation = thrown({}, round(64 * width), width)
        simulation.step(0.001)
        simulation.step(0.001)
        visited.append(Counter())
        for _ in range(3):
            simulation.step(0.001)
    narrow, wide = visited[1:]
    assert {"prepare", "contact", "crowd", "alone", "number", "count_fluid"} <= set(narrow)
    assert all(wide[name] <= 1.2 * narrow[name] for name in narrow)


def test_a_dirty_region_covers_the_last_window():
    grid = StaggeredGrid((20, 10, 1), 1.0, 2)
    trail = DirtyRegion(grid.domain)
    boxes = [
        grid.window((2, 2, 1), (4, 4, 1)),
        grid.window((5, 3, 1), (7, 8, 1)),
        grid.window((5, 3, 1), (6, 5, 1)),
    ]
    through = [trail.through(window) for window in boxes]
    # The former contents are unknown.
    assert (through[0].low, through[0].high) == (grid.domain.low, grid.domain.high)
    assert (through[1].low, through[1].high) == ((1, 2, 2), (2, 9, 8))
    assert (through[2].low, through[2].high) == ((1, 3, 5), (2, 9, 8))
    trail.forget()
    assert trail.through(boxes[0]).high == grid.domain.high
    assert trail.through(None).high == grid.domain.high
