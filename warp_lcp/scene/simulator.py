"""Simulator plug-ins, found by the entry-point group `warp_lcp.simulators`."""

from __future__ import annotations

import functools
import inspect
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeGuard, TypeVar, runtime_checkable

from warp_lcp.simulation import HasPieces, Simulation

if TYPE_CHECKING:
    from warp_lcp.distributed.ranks import Ranks
    from warp_lcp.scene.scene import Scene

PlugIn = TypeVar("PlugIn")


@runtime_checkable
class Simulator(Protocol):
    """Simulator plug-in: a kind of material and the scenes that describe it."""

    name: str
    summary: str

    @property
    def scene_model(self) -> type[Scene]:
        """The class of its scenes, a subclass of `Scene`."""

    def create(self, scene: Scene, *, device: str, folder: Path) -> Simulation:
        """Build the simulation of a scene.

        Files that the scene names are relative to `folder`.

        Raises:
            ValueError: the scene cannot be simulated; the message names the key and what is
                allowed.
        """


class RankedSimulator(Protocol):
    """Simulator plug-in whose simulations run on several MPI ranks."""

    def create(self, scene: Scene, *, device: str, folder: Path, ranks: Ranks) -> HasPieces:
        """Build this rank's part of the simulation of a scene; collective."""


def runs_on_ranks(simulator: Simulator) -> TypeGuard[RankedSimulator]:
    """Return whether a plug-in's simulations run on several MPI ranks.

    Its `create` then has an argument `ranks`, is collective with the same scene on all ranks, and
    returns this rank's part, a `warp_lcp.simulation.HasPieces`.
    """
    return "ranks" in inspect.signature(simulator.create).parameters


@functools.cache
def entry_points(group: str) -> metadata.EntryPoints:
    """Return the entry points of a group; packages are searched once per process."""
    return metadata.entry_points(group=group)


def simulators() -> dict[str, Simulator]:
    """Return the installed simulators by name."""
    return plug_ins("warp_lcp.simulators", Simulator, "a simulator")


def plug_ins(group: str, kind: type[PlugIn], what: str) -> dict[str, PlugIn]:
    """Return the objects loaded by the entry points of a group, by name.

    Raises:
        TypeError: an object is not of this kind, which `what` names.
    """
    loaded: dict[str, PlugIn] = {}
    for entry in entry_points(group=group):
        loaded[entry.name] = entry.load()
        if not isinstance(loaded[entry.name], kind):
            raise TypeError(
                f"entry point {entry.name!r} of {group} is not {what}: {loaded[entry.name]!r}"
            )
    return loaded
