"""Simulator of falling dots: deterministic, NumPy only, fails on request."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from small_runs import MINIMAL
from warp_lcp.scene import simulator as plug_ins
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Cells, Part, Points


class Dots:
    """Points that fall and bounce; the faster they are, the shorter are the steps."""

    def __init__(self, owner: DotsSimulator, scene: Scene) -> None:
        self.owner = owner
        self.gravity = np.array(scene.physics.gravity)
        self.position = np.random.default_rng(7321).random((owner.count, 2))
        self.velocity = np.zeros((owner.count, 2))
        self.time = 0.0
        self.step_count = 0

    def stable_dt(self) -> float:
        return (
            self.owner.stable_dt
            if self.owner.stable_dt is not None
            else 0.02 / (1.0 + np.abs(self.velocity).max(initial=0.0))
        )

    def step(self, dt: float) -> dict[str, float | int | str | None]:
        self.owner.before_step(self, dt)
        self.velocity += dt * self.gravity
        self.position += dt * self.velocity
        below = self.position[:, 1] < 0
        self.velocity[below, 1] *= -0.7
        self.position[below, 1] *= -1
        self.time += dt
        self.step_count += 1
        return {
            "max_speed": float(np.abs(self.velocity).max(initial=0.0)),
            "solve_status": self.owner.status,
            "volume": None,
        }

    def columns(self) -> tuple[str, ...]:
        return ("max_speed", "solve_status", "volume")

    def frame(self) -> list[Part]:
        points = np.column_stack([self.position, np.zeros(len(self.position))]).astype(np.float32)
        index = np.unique(np.clip(points * 8, 0, 7).astype(np.int32), axis=0)
        return [
            Points("particles", points, {"velocity": np.pad(self.velocity, ((0, 0), (0, 1)))}),
            Cells("grid", index, 0.125, 2, {"wall": index[:, 1] == 0}),
        ]

    def state(self) -> dict[str, np.ndarray]:
        scalars = {"time": np.array(self.time), "step_count": np.array(self.step_count)}
        return {"position": self.position.copy(), "velocity": self.velocity.copy(), **scalars}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        if state["position"].shape != self.position.shape:
            raise ValueError("another number of dots")
        self.position, self.velocity = state["position"].copy(), state["velocity"].copy()
        self.time, self.step_count = float(state["time"]), int(state["step_count"])

    def notes(self) -> list[str]:
        return self.owner.notes


class DotsSimulator:
    """Plug-in with settings for the tests."""

    name = "dots"
    summary = "dots that fall"
    scene_model: type[Scene] = Scene

    def __init__(self) -> None:
        self.count = 50
        self.notes: list[str] = []
        self.stable_dt: float | None = None
        self.refuse = ""
        self.status = "CONVERGED"
        self.before_step: Callable[[Dots, float], None] = lambda simulation, dt: None

    def create(self, scene: Scene, *, device: str, folder: Path) -> Dots:
        if self.refuse:
            raise ValueError(self.refuse)
        return Dots(self, scene)


@pytest.fixture
def dots(monkeypatch: pytest.MonkeyPatch) -> DotsSimulator:
    """Install the simulator `dots` as the only one."""
    simulator = DotsSimulator()

    class DotsEntryPoint:
        name = "dots"

        def load(self) -> DotsSimulator:
            return simulator

    monkeypatch.setattr(plug_ins, "entry_points", lambda group: [DotsEntryPoint()])
    return simulator


@pytest.fixture
def scene_file(dots: DotsSimulator, tmp_path: Path) -> Path:
    """Write a minimal scene of dots."""
    path = tmp_path / "dots.toml"
    path.write_text(MINIMAL)
    return path
