"""Models that are off: no loaded kernel module, no memory, no log column."""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import warp as wp

import small_liquids
import small_sands
from warp_lcp.kernels import kernel_variant as pass_form
from warp_lcp.kernels import launch_graph as program

PACKAGES = ("warp_lcp", "fluids", "granular")
ROOT = Path(__file__).parents[2]


@dataclass
class SimulationTraces:
    """Traces of a simulation: kernel modules and allocated bytes.

    Bytes are by source file, and in total.
    """

    modules: set[str] = field(default_factory=set)
    bytes: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    total: int = 0
    columns: tuple[str, ...] = ()


@contextmanager
def watching(patch: pytest.MonkeyPatch) -> Iterator[SimulationTraces]:
    """Record each kernel module of a launch, and each allocation.

    Allocations are recorded with the source files on the stack.
    """
    traces, prepared = SimulationTraces(), program.prepared
    allocator = type(wp.get_device("cpu").default_allocator)
    load, allocate, entry, make_array = (
        wp.Module.load,
        allocator.allocate,
        pass_form.KernelVariant.entry,
        wp.array.__init__,
    )

    def noting_load(module: Any, *arguments: Any, **options: Any) -> Any:
        traces.modules.add(module.name)
        return load(module, *arguments, **options)

    def noting_entry(self: Any, *arguments: Any) -> Any:
        traces.modules.add(self.kernel.module.name)
        return entry(self, *arguments)

    def noting_prepared(kernel: Any, *arguments: Any) -> Any:
        traces.modules.add(kernel.module.name)
        return prepared(kernel, *arguments)

    def note(size: int) -> None:
        traces.total += size
        frame, files = sys._getframe(2), set()
        while frame is not None:
            files.add(frame.f_code.co_filename)
            frame = frame.f_back
        for name in files:
            path = Path(name).resolve()
            if path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in PACKAGES:
                traces.bytes[path.relative_to(ROOT).as_posix()] += size

    def noting_allocate(self: Any, size: int) -> int:
        note(size)
        return int(allocate(self, size))

    def noting_array(self: wp.array, *arguments: Any, **options: Any) -> None:
        make_array(self, *arguments, **options)
        if options.get("deleter") is not None:  # of NumPy's memory, see `rows.fields.zeros`
            note(self.capacity)

    with patch.context() as patched:
        patched.setattr(wp.Module, "load", noting_load)
        patched.setattr(program, "prepared", noting_prepared)
        patched.setattr(pass_form.KernelVariant, "entry", noting_entry)
        patched.setattr(allocator, "allocate", noting_allocate)
        patched.setattr(wp.array, "__init__", noting_array)
        yield traces


BALL = {"shape": "sphere", "center": [0.7, 0.2], "radius": 0.1}
SWAYING = BALL | {"motion": {"kind": "sinusoid", "amplitude": [0.02, 0.0], "period": 1.0}}
QUIET = {"diagnostics": False}
LIQUID: dict[str, Any] = {
    "size": [1.0, 0.5],
    "resolution": 16,
    "liquid": [small_liquids.box([0.0, 0.0], [0.375, 0.375])],
    "wall": "free-slip",
    "pressure": {"surface": "voxel"},
    "output": QUIET,
}
THICK: dict[str, Any] = {
    "size": [1.0, 0.5, 0.25],
    "liquid": [small_liquids.box([0.0, 0.0, 0.0], [0.375, 0.375, 0.25])],
}
SAND: dict[str, Any] = {
    "size": [1.0, 0.5],
    "resolution": 16,
    "sand": [small_sands.box([0.0, 0.0], [0.375, 0.375])],
    "output": QUIET,
}


def traces_of(patch: pytest.MonkeyPatch, tables: dict[str, Any], *, sand: bool) -> SimulationTraces:
    """Build a simulation, step it and make a frame."""
    model = (
        small_sands.scene(**(SAND | tables)) if sand else small_liquids.scene(**(LIQUID | tables))
    )
    with watching(patch) as traces:
        simulation: Any = small_sands.create(model) if sand else small_liquids.create(model)
        for _ in range(2):
            simulation.step(min(simulation.stable_dt(), 0.01))
        simulation.frame()
    traces.columns = simulation.columns()
    return traces


WITHOUT: dict[str, SimulationTraces] = {}


def traces_without(case: OnOffModel, patch: pytest.MonkeyPatch) -> SimulationTraces:
    """Return the traces of a case's scene without its model; cases share the scene."""
    key = f"{case.sand} {case.off}"
    if key not in WITHOUT:
        WITHOUT[key] = traces_of(patch, case.off, sand=case.sand)
    return WITHOUT[key]


@dataclass(frozen=True)
class OnOffModel:
    """Model, on and off.

    Args:
        on, off: tables of the scene with the model, and of the nearest one without it.
        modules: names, or their beginnings, of the model's own kernel modules.
        files: source files on the stack of the model's allocations.
        columns: log columns of the model.
        sand: whether the scene has sand.
    """

    on: dict[str, Any]
    off: dict[str, Any] = field(default_factory=dict)
    modules: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    sand: bool = False


CASES = {
    "cut cells": OnOffModel(
        {"solid": [BALL]},
        {"solid": [BALL], "solids": "voxel"},
        modules=(
            "warp_lcp.grid.cut_cells",
            "warp_lcp.grid.distance_advection",
            "warp_lcp.material.cut_wall",
            "fluids.pressure_cut",
        ),
        files=("warp_lcp/grid/cut_cells.py",),
    ),
    "moving solids": OnOffModel(
        {"solid": [SWAYING]},
        {"solid": [BALL]},
        modules=("warp_lcp.grid.push_out", "fluids.pressure_cut_moving"),
        columns=("pushed", "stuck"),
    ),
    "rigid bodies": OnOffModel(
        {"solid": [BALL | {"density": 500.0}]},
        {"solid": [SWAYING]},
        modules=("fluids.coupling", "warp_lcp.low_rank"),
        files=("fluids/coupling.py", "warp_lcp/operators/low_rank.py"),
        columns=("body0_x", "contacts"),
    ),
    "ghost-fluid surface": OnOffModel(
        {"pressure": {}},
        {"density_correction": {"every": 0}},
        modules=("fluids.pressure_ghost", "warp_lcp.grid.density"),
        files=("fluids/surface.py", "warp_lcp/grid/level_set.py"),
    ),
    "smoothing": OnOffModel({"pressure": {"smoothing": 2}}, {"pressure": {}}),
    "surface tension": OnOffModel(
        {"pressure": {}, "surface_tension": {"coefficient": 0.072}},
        {"pressure": {}},
        modules=("fluids.surface_tension",),
        files=("fluids/surface_tension.py",),
    ),
    "whitewater": OnOffModel(
        {"pressure": {}, "whitewater": {}},
        {"pressure": {}},
        modules=("fluids.whitewater",),
        files=("fluids/whitewater.py",),
        columns=("whitewater_spray", "whitewater_foam", "whitewater_bubbles"),
    ),
    "separating walls": OnOffModel(
        {"wall": "separating"}, modules=("warp_lcp.bounds",), files=("warp_lcp/problem/bounds.py",)
    ),
    "unilateral pressure": OnOffModel(
        {"pressure": {"model": "unilateral"}},
        {"pressure": {}},
        modules=("fluids.unilateral_pressure",),
        files=("fluids/unilateral_pressure.py",),
    ),
    "FLIP": OnOffModel({"particles": {"transfer": "flip"}}, {"particles": {"transfer": "pic"}}),
    "density correction": OnOffModel(
        {"density_correction": {}},
        {"density_correction": {"every": 0}},
        modules=("warp_lcp.material.density_correction",),
        files=("warp_lcp/material/density_correction.py",),
        columns=("density_status", "density_iterations", "max_density"),
    ),
    "reseeding": OnOffModel(
        {"particles": {"reseed": {"every": 1}}},
        modules=("warp_lcp.material.reseeding",),
        files=("warp_lcp/material/reseeding.py",),
        columns=("reseeded",),
    ),
    "narrow band": OnOffModel(
        {"pressure": {}, "particles": {"narrow_band": {"width": 3.0}}},
        {"pressure": {}},
        modules=("warp_lcp.material.narrow_band", "warp_lcp.grid.semi_lagrangian"),
        files=("warp_lcp/material/narrow_band.py",),
        columns=("interior_density",),
    ),
    "sources": OnOffModel(
        {"source": [small_liquids.box([0.9, 0.4], [1.0, 0.5], velocity=[-1.0, 0.0])]},
        modules=("warp_lcp.material.sources",),
        files=("warp_lcp/material/sources.py",),
        columns=("emitted",),
    ),
    "outlets": OnOffModel(
        {"drain": [small_liquids.box([0.0, 0.0], [0.1, 0.1])]},
        modules=("warp_lcp.material.outlets",),
        files=("warp_lcp/material/sources.py",),
        columns=("drained",),
    ),
    "surface mesh": OnOffModel(
        {"output": QUIET | {"surface": True}},
        modules=("warp_lcp.grid.surface_mesh", "warp_lcp.grid.marching_cubes"),
        files=("warp_lcp/grid/surface_mesh.py", "warp_lcp/grid/marching_cubes.py"),
    ),
    "volume": OnOffModel(
        THICK | {"output": QUIET | {"volume": True}},
        THICK,
        files=("warp_lcp/material/particle_volume.py",),
    ),
    "diagnostics": OnOffModel(
        {"pressure": {}, "output": {}},
        {"pressure": {}},
        modules=("warp_lcp.grid.volume",),
        columns=("volume", "max_divergence"),
    ),
    "automatic tolerance": OnOffModel(
        {"solver": {"tolerance": "auto"}},
        modules=("warp_lcp.tolerance",),
        files=("fluids/tolerance.py",),
        columns=("tolerance", "time_error"),
    ),
    "probes": OnOffModel(
        {"probe": [{"name": "a", "position": [0.1, 0.1], "quantity": "pressure"}]},
        modules=("fluids.probes",),
        files=("fluids/probes.py",),
    ),
    "forces on solids": OnOffModel(
        {"output": QUIET | {"forces": True}},
        modules=("fluids.forces",),
        files=("fluids/forces.py",),
    ),
    "drag along walls": OnOffModel(
        {"wall_drag": {"coefficient": 0.01}},
        modules=("fluids.wall_drag",),
        files=("fluids/wall_drag.py", "fluids/forces.py"),
        columns=("drag_work",),
    ),
    "rigid bodies in sand": OnOffModel(
        {"solid": [BALL | {"density": 500.0}]},
        {"solid": [SWAYING]},
        modules=("granular.bodies",),
        files=("granular/bodies.py",),
        columns=("body0_x", "contacts"),
        sand=True,
    ),
    "friction of walls": OnOffModel({"friction": 0.4}, {"friction": 0.0}, sand=True),
    "friction of walls by sweeps": OnOffModel(
        {"friction": 0.4, "solver": {"method": "interleaved-sweeps", "max_iterations": 20}},
        {"friction": 0.0, "solver": {"method": "interleaved-sweeps", "max_iterations": 20}},
        sand=True,
    ),
    "box of friction": OnOffModel(
        {"friction": {"model": "box"}}, modules=("granular.stress_2d_float32_step_box",), sand=True
    ),
    "friction that grows with the rate": OnOffModel(
        {"friction": {"dynamic_angle": 40.0, "grain_size": 0.01}},
        modules=("granular.stress_2d_float32_step_rate",),
        sand=True,
    ),
    "sweeps": OnOffModel(
        {"solver": {"method": "interleaved-sweeps", "max_iterations": 20}},
        modules=("granular.interleaved_2d",),
        sand=True,
    ),
    "gauge": OnOffModel({"gauge": {"height": 0.2}}, columns=("flow_rate",), sand=True),
    "cohesion": OnOffModel({"material": {"cohesion": 200.0, "tensile_strength": 50.0}}, sand=True),
    "diagnostics of sand": OnOffModel(
        {"output": {}}, columns=("yielded", "dissipation", "predicted_excess", "front"), sand=True
    ),
    "density correction of sand": OnOffModel(
        {"density_correction": {}},
        {"density_correction": {"every": 0}},
        modules=("warp_lcp.material.density_correction",),
        files=("warp_lcp/material/density_correction.py",),
        columns=("density_status", "density_iterations", "max_density"),
        sand=True,
    ),
}


# They replace another model, only read, or are settings of kernels that are there anyway.
PLACED_ELSEWHERE = (
    "cut cells",
    "diagnostics",
    "diagnostics of sand",
    "unilateral pressure",
    "box of friction",
    "sweeps",
    "gauge",
    "cohesion",
    "friction that grows with the rate",
)


@pytest.mark.parametrize("name", CASES)
def test_a_model_that_is_off_leaves_no_trace(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES[name]
    off = traces_without(case, monkeypatch)
    on = traces_of(monkeypatch, case.on, sand=case.sand)
    for own in case.modules:  # the detection of the model's traces must work
        assert any(module.startswith(own) for module in on.modules), (
            f"{own} is not among {sorted(on.modules)}"
        )
        assert not any(module.startswith(own) for module in off.modules)
    for file in case.files:
        assert on.bytes[file] > 0
        assert file not in off.bytes
    assert set(case.columns) <= set(on.columns)
    assert not set(case.columns) & set(off.columns)
    if name not in PLACED_ELSEWHERE:
        assert on.total > off.total


def test_without_a_separating_wall_bounds_take_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    off, on = (
        traces_of(monkeypatch, {"wall": wall}, sand=False) for wall in ("free-slip", "separating")
    )
    cells = 3 * 10 * 18  # stored cells
    assert on.total - off.total >= 8 * cells, "a lower bound"


@pytest.mark.parametrize("slips", [True, False])
def test_walls_without_friction_are_not_launched(
    slips: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Walls without friction: no launches.

    The kernel of Coulomb friction on walls runs and reads faces only where a wall has friction; a
    solid with friction counts its own faces alone.
    """
    simulation = small_sands.create(
        small_sands.scene(**(SAND | {"friction": 0.0 if slips else 0.3}))
    )
    ran: list[str] = []
    entry = pass_form.KernelVariant.entry
    monkeypatch.setattr(
        pass_form.KernelVariant,
        "entry",
        lambda form, *given: (ran.append(form.kernel.key), entry(form, *given))[1],
    )
    walls, faces = simulation.stress.walls, 2 * (16 + 8)  # walls of the box
    assert walls.count == (0 if slips else faces)
    simulation.step(1e-3)
    assert simulation.stress.residual()[0] >= 0.0
    assert any("step" in key for key in ran)
    assert any("wall" in key for key in ran) == (not slips)
    solid = {"solid": [small_sands.box([0.5, 0.0], [0.75, 0.125], friction=0.3)], "friction": 0.0}
    rough = small_sands.create(small_sands.scene(**(SAND | solid))).stress.walls
    assert set(rough.walls.numpy()) == {1}, "faces of the solid"


def test_cohesion_takes_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    off, on = (
        traces_of(monkeypatch, {"material": {"cohesion": c, "tensile_strength": c}}, sand=True)
        for c in (0.0, 100.0)
    )
    assert (on.total, on.modules, on.columns) == (off.total, off.modules, off.columns)


def test_a_plane_has_no_third_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = small_liquids.create(small_liquids.scene(**LIQUID))
    assert (
        len(simulation.velocity) == len(simulation.weights) == len(simulation.projection.known) == 2
    )


def test_a_closed_box_full_of_liquid_has_no_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    full = {
        "liquid": [small_liquids.box([0.0, 0.0], [1.0, 0.5])],
        "pressure": {"surface": "ghost-fluid", "smoothing": 1},
    }
    model = small_liquids.scene(**(LIQUID | full))
    said = {part.name: part for part in model.models()}
    assert not said["ghost-fluid surface"].built
    assert "closed box" in said["ghost-fluid surface"].why
    assert ("not built", f"ghost-fluid surface: {said['ghost-fluid surface'].why}") in model.plan()
    traces = traces_of(monkeypatch, full | {"output": {}}, sand=False)
    assert "warp_lcp/grid/level_set.py" not in traces.bytes
    assert not any(
        "ghost" in module or module.startswith("warp_lcp.grid.density") for module in traces.modules
    )
    assert "surface" not in model.memory_parts()
    simulation = small_liquids.create(
        small_liquids.scene(**(LIQUID | full | {"output": {}, "solid": [BALL]}))
    )
    row = simulation.step(0.01)
    assert row["volume"] == pytest.approx(0.5 - math.pi * 0.01, rel=0.01)
    assert row["max_speed"] < 1e-3, "it rests"
    tapped = small_liquids.scene(
        **(LIQUID | full | {"domain": {"size": [1.0, 0.5], "resolution": 16, "open": ["top"]}})
    )
    assert {part.name for part in tapped.models() if part.built} >= {"ghost-fluid surface"}


def test_open_sides_build_no_separating_walls() -> None:
    domain = {
        "size": [1.0, 0.5],
        "resolution": 16,
        "open": ["left", "right", "top", "bottom"],
        "wall": "separating",
    }
    model = small_liquids.scene(**(LIQUID | {"domain": domain}))
    walls = next(part for part in model.models() if part.name == "separating walls")
    assert not walls.built
    simulation = small_liquids.create(model)
    simulation.step(0.01)
    assert simulation.projection.fields()[2] is simulation.projection._start, "no field of bounds"


def test_unilateral_pressure_builds_no_coupled_solve() -> None:
    thick = LIQUID | {"viscosity": {"value": 10.0}}
    coupled = small_liquids.scene(**thick)
    assert ("coupled solve", True) in [(part.name, part.built) for part in coupled.models()]
    model = small_liquids.scene(**(thick | {"pressure": {"model": "unilateral"}}))
    solve = next(part for part in model.models() if part.name == "coupled solve")
    assert not solve.built
    assert ("not built", f"coupled solve: {solve.why}") in model.plan()
    assert small_liquids.create(model).stokes is None
