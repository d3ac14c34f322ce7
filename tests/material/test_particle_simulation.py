"""Minimal particle simulation without a solve: falling dust.

Properties of all particle simulations must hold for it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.material.particle_assembly import (
    GridComponents,
    make_boundary,
    make_outlets,
    make_particles,
    make_sources,
)
from warp_lcp.material.particle_log import Row
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.scene.shapes import BoxTable, MaterialProperties
from warp_lcp.simulation import HasRecordedProblems, HasResampling, HasStages, SimulationFailed

GRAVITY = 9.81
BLOCK = {"shape": "box", "min": [0.25, 0.5], "max": [0.75, 0.75], "velocity": [0.5, 0.0]}


class DustBox(MaterialProperties, BoxTable):
    """Box of dust."""


class DustScene(ParticleScene):
    """Scene of dust."""

    dust: list[DustBox] = []

    def materials(self) -> tuple[str, list[DustBox]]:
        """Return the dust."""
        return "dust", self.dust


class Dust(ParticleSimulation):
    """Simulation of particles without interaction."""

    def __init__(self, scene: DustScene, **parts: Any) -> None:
        super().__init__(scene, **parts)
        self.kind, self.contact = self.grid.field(wp.int8), self.grid.field(wp.uint8)
        self.known = self.grid.faces(wp.int8)
        self.mark()

    def mark(self) -> None:
        cells = self.boundary.base.numpy().copy().ravel()
        cells[self.particles.key.numpy()[: self.particles.count]] = wl.FLUID
        self.kind.assign(cells.reshape(self.grid.shape))

    def own_columns(self) -> tuple[str, ...]:
        return ("grains",)

    def own_state(self) -> dict[str, np.ndarray]:
        return {"cells": self.kind.numpy().copy()}

    def restore_own(self, state: Mapping[str, np.ndarray]) -> None:
        self.kind.assign(state["cells"])

    def step(self, dt: float) -> Row:
        totals = self.begin_step(dt)
        window = self.window(totals)
        self.particles_to_grid(window)
        self.mark()
        for marks, weight in zip(self.known, self.weights, strict=True):
            marks.assign((weight.numpy() > TINY_WEIGHT).astype(np.int8))
        self.extrapolate_velocity(window, self.known, self.kind, self.contact)
        self.grid_to_particles(window, self.kind, dt)
        return self.logged(
            self.move(dt, window) | self.solve_row(None) | {"grains": 7, "unasked": 1}
        )


def make(resolution: int = 16, **tables: Any) -> Dust:
    data = {
        "scene": {"simulator": "dust"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0, 1.0], "resolution": resolution} | tables.pop("domain", {}),
        "dust": [BLOCK],
    }
    scene = DustScene.model_validate(data | tables)
    grid = StaggeredGrid(scene.cell_counts, scene.spacing, scene.dimension, "cpu")
    boundary, _ = make_boundary(scene, grid, Path())
    particles, notes = make_particles(scene, grid, boundary, Path())
    sources, outlets = (
        make_sources(scene, grid, boundary, Path()),
        make_outlets(scene, grid, Path()),
    )
    return Dust(
        scene,
        grid=grid,
        parts=GridComponents(boundary, sources),
        particles=particles,
        outlets=outlets,
        notes=notes,
    )


def test_material_falls_freely() -> None:
    """Free fall, whatever the steps.

    The center falls by g t^2 / 2, and v = -g t in the middle of the last step, exactly, in every
    particle.
    """
    simulation = make()
    center = simulation.particles.totals().center
    for dt in (0.02, 0.03, 1e-6, 0.04, 0.01, 0.002, 0.058):
        row = simulation.step(dt)
    time = simulation.time
    assert time == pytest.approx(0.160001)
    middle = np.array([0.5, -GRAVITY * (time - 0.5 * dt), 0.0])
    assert simulation.particles.velocity.numpy() == pytest.approx(
        np.tile(middle, (8 * 4 * 4, 1)), rel=1e-4
    )
    assert simulation.particles.totals().center == pytest.approx(
        center + np.array([0.5, -0.5 * GRAVITY * time, 0.0]) * time, rel=1e-6
    )
    mass = 1000.0 * 0.5 * 0.25
    assert row["mass"] == pytest.approx(mass)
    assert row["kinetic_energy"] == pytest.approx(
        0.5 * mass * (0.25 + (GRAVITY * time) ** 2), rel=1e-4
    )
    assert (row["grains"], row["solver"], row["stopped"]) == (7, None, 0)
    assert tuple(row) == simulation.columns()


def test_the_simulation_implements_the_driver_protocol() -> None:
    simulation = make()
    assert isinstance(simulation, HasStages)
    assert isinstance(simulation, HasResampling)
    assert not isinstance(
        simulation, HasRecordedProblems
    )  # it solves nothing that could be recorded
    assert simulation.points().fields["speed"] == pytest.approx(np.full(128, 0.5))
    assert simulation.notes() == ["128 particles, 16 x 16 cells of 0.0625 m"]


def test_a_simulation_resumes_bit_for_bit() -> None:
    tables = {
        "particles": {"transfer": "flip", "reseed": {"every": 1}},
        "density_correction": {"every": 2},
        "domain": {"open": ["bottom"]},
    }
    through, later = make(**tables), make(**tables)
    for _ in range(16):
        through.step(0.02)
    saved = through.state()
    later.restore(saved)
    for _ in range(2):
        assert through.step(0.02) == later.step(0.02)
    assert all(
        np.array_equal(value, later.state()[name]) for name, value in through.state().items()
    )
    # Some have left, so that lengths differ from the initial ones.
    assert 0 < through.particles.count < 128
    with pytest.raises(ValueError, match="lacks cells"):
        later.restore({name: value for name, value in saved.items() if name != "cells"})


def test_solids_of_another_scene_are_refused() -> None:
    wall = {"shape": "box", "min": [0.0, 0.0], "max": [1.0, 0.125]}
    with pytest.raises(ValueError, match="solids are not"):
        make().restore(make(solid=[wall], domain={"solids": "voxel"}).state())


def test_a_simulation_resumes_on_a_finer_grid() -> None:
    coarse, fine = make(), make(32)
    for _ in range(3):
        coarse.step(0.02)
    assert "512 particles replace 128" in fine.resample(coarse.state())[0]
    assert fine.time == coarse.time
    held = fine.particles.cells_of(fine.particles.position.numpy())[:, ::-1] + 1
    # The marks are updated: it has moved by a cell.
    assert (np.argwhere(fine.kind.numpy() == wl.FLUID) == np.unique(held, axis=0)).all()
    assert fine.step(0.01)["mass"] == pytest.approx(125.0)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("velocity", np.nan, "velocity is not finite"),
        ("position", 2.0, "position is outside the domain"),
    ],
)
def test_non_finite_values_end_the_run(name: str, value: float, message: str) -> None:
    simulation = make()
    array = simulation.particles.arrays()[name]
    host = array.numpy()
    host[5] = value
    array.assign(host)
    with pytest.raises(
        SimulationFailed, match=rf"^at the start of step 0: {message} in cell .* \(1 particles\)"
    ):
        simulation.step(0.01)


def test_start_and_stop_times_are_reported() -> None:
    source = {
        "shape": "box",
        "min": [0.0, 0.9],
        "max": [0.1, 1.0],
        "velocity": [1.0, 0.0],
        "start": 0.004,
    }
    drain = {"shape": "box", "min": [0.0, 0.0], "max": [0.1, 0.1], "start": 0.002, "stop": 0.3}
    slide = {"kind": "translation", "velocity": [0.1, 0.0], "start": 0.0015, "stop": 0.25}
    solid = {"shape": "box", "min": [0.3, 0.1], "max": [0.5, 0.3], "motion": slide}
    simulation = make(source=[source], drain=[drain], solid=[solid])
    assert sorted(simulation.events(0.2)) == [0.0015, 0.002, 0.004]
    simulation.step(0.001)
    simulation.step(0.002)
    assert sorted(simulation.events(1.0)) == [0.004, 0.25, 0.3]


def test_a_source_that_will_start_shortens_the_step_before() -> None:
    source = {
        "shape": "box",
        "min": [0.0, 0.9],
        "max": [0.1, 1.0],
        "velocity": [8.0, 0.0],
        "start": 0.1,
        "stop": 0.2,
    }
    simulation, without = make(source=[source]), make()
    assert simulation.stable_dt() == without.stable_dt()
    simulation.time = 0.09
    assert simulation.stable_dt() == pytest.approx(2.0 / 16 / (8.0 + (2.0 * GRAVITY / 16) ** 0.5))
    simulation.time = 0.2
    assert simulation.stable_dt() == without.stable_dt()


def test_a_source_that_starts_fills_its_cells() -> None:
    source = {
        "shape": "box",
        "min": [0.0, 0.9],
        "max": [0.1, 1.0],
        "velocity": [1.0, 0.0],
        "start": 0.004,
    }
    simulation = make(source=[source])
    simulation.step(0.001)
    assert simulation.columns()[-1] == "emitted"
    assert simulation.step(0.003)["emitted"] == 2 * 2 * 4
    with pytest.raises(ValueError, match=r"dt = 0\.0"):
        simulation.step(0.0)
