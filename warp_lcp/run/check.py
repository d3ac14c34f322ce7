"""Check a scene before its run, and summarize the run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from warp_lcp.distributed.ranks import Ranks
from warp_lcp.files.size_limits import one_line
from warp_lcp.frames.meshio_format import MeshConversion, holds
from warp_lcp.run.devices import free_memory
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import check_shapes, load_scene
from warp_lcp.scene.simulator import runs_on_ranks, simulators
from warp_lcp.scene.table import KeyFault, SceneError, written
from warp_lcp.simulation import Cells, Points, Simulation, Surface

EVERYTHING = ("vtu", "xdmf", "vtk", "gmsh")  # formats that store all parts with their fields


def check_scene(
    path_or_name: str, overrides: Sequence[str] = ()
) -> tuple[Scene, list[tuple[str, str]]]:
    """Return a scene, with its shapes built once, and a summary of its run.

    The summary has pairs of a word and a line.

    Args:
        path_or_name: see `load_scene`.
        overrides: see `load_scene`.

    Raises:
        SceneError: listing everything that is wrong.
    """
    scene = load_scene(path_or_name, overrides)
    check_shapes(scene, path_or_name)
    _check_bodies(scene, path_or_name)
    check_output(scene)
    return scene, [("scene", scene.scene.name), ("simulator", scene.scene.simulator), *scene.plan()]


def check_memory(scene: Scene, device: str, *, share: float = 1.0) -> None:
    """Raise an error if a scene needs more memory than a device has free.

    Args:
        scene: the scene.
        device: a Warp device's name; on a GPU, the host memory for the creation of the particles is
            not counted.
        share: fraction of the run on this device.

    Raises:
        SceneError: names both amounts.
    """
    needed = int(
        share * (scene.memory_estimate() if device == "cpu" else sum(scene.memory_parts().values()))
    )
    free = free_memory(device) if needed else None
    if free is not None and needed > free:
        largest = ", ".join(
            sorted(scene.memory_parts(), key=scene.memory_parts().__getitem__, reverse=True)[:2]
        )
        message = (
            f"the run needs about {needed / 2**20:,.0f} MB of memory, most of it for {largest}, "
            f"and {free / 2**20:,.0f} MB are free on "
            f"{device}; lower domain.resolution, or run it anyway with --force-memory"
        )
        raise SceneError(
            scene.scene.name, [KeyFault("domain.resolution", message, str(scene.domain.resolution))]
        )


def check_ranks(scene: Scene) -> None:
    """Raise an error if a scene cannot run on ranks, or lacks a parallel format.

    Raises:
        SceneError: lists all reasons.
    """
    name = scene.scene.simulator
    problems = []
    if not runs_on_ranks(simulators()[name]):
        problems.append(
            KeyFault(
                "scene.simulator",
                "runs on one process only; leave out --engine petsc",
                written(name),
            )
        )
    if scene.output.format != "vtu":
        problems.append(
            KeyFault(
                "output.format",
                "--engine petsc writes only .vtu pieces",
                written(scene.output.format),
            )
        )
    if scene.output.surface_ply:
        problems.append(
            KeyFault(
                "output.surface_ply", "--engine petsc writes surfaces only as .vtu pieces", "true"
            )
        )
    if problems:
        raise SceneError(scene.scene.name, problems)


def check_output(scene: Scene) -> list[str]:
    """Check that each format can store the scene's output; return notes.

    A note names the parts whose fields the format does not store.

    Raises:
        SceneError: names the parts, the reason, and what the format can store.
    """
    output = scene.output
    if output.format == "vtu":
        return []
    if output.format == "ply" and output.surface_ply:
        raise SceneError(
            scene.scene.name,
            [
                KeyFault(
                    "output.surface_ply",
                    'is redundant: output.format = "ply" writes surfaces as PLY, too; leave one '
                    "out",
                    "true",
                )
            ],
        )
    has_bodies, cells = any(solid.is_body for solid in scene.solid), output.grid_format == "vtu"
    kinds: dict[str, tuple[bool, type, int]] = {
        "particles": (output.particles, Points, 3),
        "whitewater": (scene.has_whitewater, Points, 3),
        "grid": (output.grid and cells, Cells, scene.dimension),
        "surface": (output.surface, Surface, scene.dimension),
        "the surfaces of bodies": (has_bodies, Surface, scene.dimension),
    }
    support = {
        name: holds(output.format, kind, dimension)
        for name, (wanted, kind, dimension) in kinds.items()
        if wanted
    }
    refused = {name: held.why for name, held in support.items() if held.dress is None}
    if refused:
        what = f"cannot store {' and '.join(refused)}"
        why = next((f" ({one_line(why.strip())})" for why in refused.values() if why.strip()), "")
        off = [f"output.{name} = false" for name in refused if name in type(output).model_fields]
        alternatives = " or ".join(name for name in EVERYTHING if name != output.format)
        raise SceneError(
            scene.scene.name,
            [
                KeyFault(
                    "output.format",
                    f"{what}{why}; "
                    + ", ".join([*off, f"or choose {alternatives}, which hold all"]),
                    written(output.format),
                )
            ],
        )
    bare = [name for name, held in support.items() if held.dress is MeshConversion.BARE]
    return (
        [
            f'output.format = "{output.format}" writes the geometry of {" and ".join(bare)}, '
            "without fields"
        ]
        if bare
        else []
    )


def start(scene: Scene, device: str, ranks: Ranks | None = None) -> Simulation:
    """Return the simulation of a scene at its start.

    Raises the errors that a run would raise before its first step.

    Args:
        scene: the scene.
        device: a Warp device's name.
        ranks: MPI ranks that share it; the result is this rank's part.

    Raises:
        SceneError: the scene cannot be simulated.
    """
    simulator = simulators()[scene.scene.simulator]
    try:
        if ranks is not None and runs_on_ranks(simulator):
            return simulator.create(scene, device=device, folder=Path.cwd(), ranks=ranks)
        return simulator.create(scene, device=device, folder=Path.cwd())
    except ValueError as error:
        check_shapes(scene, scene.scene.name)  # its error names the shape
        raise SceneError(scene.scene.name, [KeyFault("", str(error))]) from error


def _check_bodies(scene: Scene, source: str) -> None:
    """Raise an error if rigid bodies overlap each other, walls or other solids."""
    if not any(solid.is_body for solid in scene.solid):
        return
    from warp_lcp.material.particle_assembly import make_bodies, placed_solids

    try:
        make_bodies(scene, placed_solids(scene, Path.cwd()))
    except ValueError as error:
        raise SceneError(source, [KeyFault("", str(error))]) from error
