"""Simulator plug-ins, found by the entry-point group `warp_lcp.simulators`."""

from __future__ import annotations

import functools
import inspect
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from warp_lcp.simulation import Simulation

if TYPE_CHECKING:
    from warp_lcp.scene.scene import Scene


@runtime_checkable
class Simulator(Protocol):
    """Simulator plug-in: a kind of material and the scenes that describe it."""

    name: str
    summary: str
    scene_model: type[Any]  # a subclass of warp_lcp.scene.scene.Scene

    def create(self, scene: Scene, *, device: str, folder: Path) -> Simulation:
        """Build the simulation of a scene.

        Files that the scene names are relative to `folder`.

        Raises:
            ValueError: the scene cannot be simulated; the message names the key and what is
                allowed.
        """


def runs_on_ranks(simulator: Simulator) -> bool:
    """Return whether a plug-in's simulations run on several MPI ranks.

    Its `create` then has an argument `ranks`, is collective with the same scene on all ranks, and
    returns this rank's part, a `warp_lcp.simulation.Joined`.
    """
    return "ranks" in inspect.signature(simulator.create).parameters


@functools.cache
def entry_points(group: str) -> metadata.EntryPoints:
    """Return the entry points of a group; packages are searched once per process."""
    return metadata.entry_points(group=group)


def simulators() -> dict[str, Simulator]:
    """Return the installed simulators by name."""
    return plug_ins("warp_lcp.simulators", Simulator, "a simulator")


def plug_ins(group: str, kind: type[Any], what: str) -> dict[str, Any]:
    """Return the objects loaded by the entry points of a group, by name.

    Raises:
        TypeError: an object is not of this kind, which `what` names.
    """
    loaded = {}
    for entry in entry_points(group=group):
        loaded[entry.name] = entry.load()
        if not isinstance(loaded[entry.name], kind):
            raise TypeError(
                f"entry point {entry.name!r} of {group} is not {what}: {loaded[entry.name]!r}"
            )
    return loaded
