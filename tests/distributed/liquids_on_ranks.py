"""Liquids and sands on ranks; `test_liquid_on_ranks` starts this program.

`liquids_on_ranks.py WHAT,MORE FOLDER`; logs go into the folder.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import warp as wp

import small_liquids
import small_sands
from code_blocks import sponge
from small_liquids import box
from warp_lcp.distributed.balance import Balance
from warp_lcp.distributed.interruptible_wait import waiting
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.fluids import SIMULATOR, viscosity_multigrid
from warp_lcp.frames.pieces import one_mesh
from warp_lcp.frames.vtu import VtuMesh
from warp_lcp.granular.stress_methods import HeavyBallProjectedGradient
from warp_lcp.kernels.thread_pool import ThreadPool
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.simulation import SimulationFailed, StepFailed, Volume, VolumeGroup

viscosity_multigrid.GATHERED = 1024  # small enough that some levels stay distributed
EAGER = Balance(every=2, bound=1.0, fixed=0.0)  # repartitions whenever other boxes are better
DT = 0.01  # the longest step [s]
STEPS = 10
DAM_STEPS = 20
BALL = {"shape": "sphere", "radius": 0.12, "center": [0.5, 0.2, 0.25]}
DISC = {"shape": "sphere", "radius": 0.1, "center": [0.5, 0.1]}
FLAT = {"size": [1.0, 0.5], "resolution": 32, "liquid": [box([0.0, 0.0], [0.5, 0.45])]}
DEEP = {
    "size": [1.0, 0.5, 0.5],
    "resolution": 32,
    "liquid": [box([0.0, 0.0, 0.0], [0.5, 0.45, 0.5])],
}
POOL = {"size": [1.0, 0.5], "resolution": 40, "liquid": [box([0.0, 0.0], [0.7, 0.45])]}
DROP = box([0.6, 0.3, 0.1], [0.8, 0.45, 0.3], velocity=[-1.0, 0.5, 0.7])
BLADE = box(
    [0.2, 0.1, 0.2],
    [0.7, 0.25, 0.26],
    motion={"kind": "rotation", "rate": 300.0, "axis": [0, 1, 0], "center": [0.45, 0, 0.23]},
)
# Cells are cut by solids of 3 cells and more.
THICK_BLADE = BLADE | {"min": [0.28, 0.1, 0.16], "max": [0.62, 0.25, 0.3]}
OPEN = {"size": FLAT["size"], "resolution": 32, "wall": "separating", "open": ["right"]}
PROBES = [
    {"name": f"{what}_{n}", "position": place, "quantity": what}
    for n, place in enumerate(
        ([0.3, 0.1, 0.2], [0.26, 0.01, 0.4], [0.9, 0.05, 0.1], [0.51, 0.3, 0.25])
    )
    for what in ("pressure", "velocity", "level")
]
PROBES_2D = [dict(probe, position=probe["position"][:2]) for probe in PROBES]
THROWN = [  # a rotating body in the boxes of up to four ranks, and another that it meets
    box([0.35, 0.2, 0.1], [0.5, 0.4, 0.3], velocity=[1.0, 2.0, 0.0]),
    box([0.5, 0.2, 0.1], [0.65, 0.4, 0.3], velocity=[1.0, 0.5, 1.0]),
    {"shape": "sphere", "center": [0.85, 0.3, 0.3], "radius": 0.1, "velocity": [-2.0, 0.0, -0.5]},
]
CAPILLARY = {
    "surface_tension": {"coefficient": 0.5, "contact_angle": 60.0},
    "solver": {"precision": "double"},
}
TILTED = {"physics": {"gravity": [3.0, -8.0, 2.0]}}
RIVER = {
    "domain": OPEN,
    # Out of the open side, along the floor.
    "liquid": [*FLAT["liquid"], box([0.85, 0.0], [1.0, 0.3], velocity=[1.0, 0.0])],
    "source": [box([0.0, 0.2], [0.1, 0.4], velocity=[1.5, 0.2], stop=0.08)],
    "drain": [box([0.4, 0.0], [0.6, 0.1], start=0.02)],
    "solid": [box([0.6, 0.0], [0.7, 0.2], motion={"kind": "translation", "velocity": [-0.4, 0.1]})],
    "wall_drag": {"coefficient": 0.1},
    "solver": {"precision": "double"},
    "output": {"forces": True},
}
FLOATING = {  # at a cut, on the floor, in another rank's box and in the air
    "solid": [
        BALL | {"density": 300.0},
        box([0.1, 0.001, 0.1], [0.3, 0.1, 0.3], density=2000.0),
        {
            "shape": "capsule",
            "from": [0.8, 0.3, 0.2],
            "to": [0.9, 0.3, 0.3],
            "radius": 0.06,
            "density": 500.0,
            "velocity": [-1.0, 0, 0],
        },
    ],
    "wall_drag": {"coefficient": 0.1},
    "solver": {"precision": "double"},
    "output": {"forces": True},
}
RAFTS = [  # in contact at cuts
    box([0.36, 0.2], [0.499, 0.3], density=500.0, angular_velocity=-90.0),
    box([0.501, 0.21], [0.66, 0.29], mass=5.0, velocity=[-0.5, 0.0], wall="separating"),
]
COLUMN = {"size": DEEP["size"], "resolution": 24, "sand": [box([0.0, 0.0, 0.0], [0.4, 0.4, 0.5])]}
HEAP = {"size": FLAT["size"], "resolution": 32, "sand": [box([0.3, 0.0], [1.0, 0.4])]}
POURED = box([0.6, 0.35, 0.1], [0.8, 0.45, 0.4], velocity=[0.3, -1.0, 0.2])
SUNK = [  # in the sand at a cut, and in one rank's box
    BALL | {"center": [0.35, 0.35, 0.25], "mass": 8.0, "velocity": [0.5, -1.0, 0.0]},
    box([0.02, 0.41, 0.1], [0.17, 0.47, 0.3], density=900.0, angular_velocity=[0.0, 200.0, 0.0]),
]
DROPPED = [
    DISC | {"center": [0.5, 0.42], "radius": 0.06, "density": 7000.0, "velocity": [0.0, -1.0]},
    box([0.5, 0.1], [0.6, 0.2], density=900.0),
]
TRICKLING = {
    "open": ["right"],
    "drain": [box([0.4, 0.0], [0.6, 0.1], start=0.01)],
    "material": {"cohesion": 50.0},
}
UNCORRECTED = {"density_correction": {"every": 0}}
SLOPE = UNCORRECTED | {
    "physics": {"gravity": [4.0, -8.0]},
    "periodic": [True, False],
    "sand": [box([0.6, 0.0], [1.0, 0.3], velocity=[1.0, 0.0])],
}
ROUND = UNCORRECTED | {  # along x and z, over a periodic step, around a wheel
    "periodic": [True, False, True],
    "sand": [box([0.0, 0.0, 0.0], [1.0, 0.2, 0.5], velocity=[-0.8, 0.0, 0.6])],
    "solid": [box([-1.0, -1.0, -1.0], [2.0, 0.05, 2.0]), THICK_BLADE],
}
SPOUT = box([0.5, 0.45, 0.1], [0.7, 0.5, 0.3], velocity=[0.0, -0.8, 0.0], viscosity=0.5)
PLUNGER = box(
    [0.4, 0.0, 0.1],
    [0.55, 0.3, 0.3],
    wall="sticky",
    motion={"kind": "translation", "velocity": [0.3, 0.2, 0.0]},
)
THICK = {"viscosity": {"value": 20.0}, "wall": "sticky", "solid": [BALL]}
# Velocity and pressure are solved at once in every step.
COUPLED = {"viscosity": {"value": 50.0}, "solid": [DISC], "solver": {"precision": "double"}}


def walled(low, high, *, lid=False, **more):
    """Return walls of 0.3 cells around an inside."""
    width, solids = 0.3 / 32, []
    for axis in range(len(low)):
        for upper in range(2):
            least, most = [value - width for value in low], [value + width for value in high]
            if upper:
                least[axis] = high[axis]
            else:
                most[axis] = low[axis]
            if axis != 1 or lid or not upper:
                solids.append(box(least, most, **more))
    return solids


SHAKING = {"kind": "sinusoid", "period": 0.3, "amplitude": [0.06, 0.02]}
CUP = {  # at the cuts
    "solid": walled([0.31, 0.1], [0.63, 0.4]),
    "liquid": [box([0.31, 0.1], [0.63, 0.33])],
    "solver": {"precision": "double"},
}
BOTTLE = {
    "solid": walled([0.31, 0.11], [0.63, 0.4], lid=True, motion=SHAKING),
    "liquid": [box([0.31, 0.11], [0.63, 0.27])],
    "solver": {"precision": "double"},
    "output": {"forces": True},
}
HARD = {"kind": "sinusoid", "period": 0.1, "amplitude": [0.06, 0.0]}
# Several density corrections in a step.
SHAKEN_HARD = BOTTLE | {
    "solid": walled([0.31, 0.11], [0.63, 0.4], lid=True, motion=HARD),
    "cfl": 4.0,
}
TUB = {
    "solid": walled([0.31, 0.1, 0.1], [0.63, 0.4, 0.4]),
    "liquid": [box([0.31, 0.1, 0.1], [0.63, 0.33, 0.4])],
    "particles": {"transfer": "flip"},
    "solver": {"precision": "double"},
}
SHEET = box([0.25, 0.2], [0.6, 0.2095], density=800.0)  # a rigid one, in the water and out of it
SUNKEN = {"solid": [SHEET], "solver": {"precision": "double"}}
THICK_CUP = {"viscosity": {"value": 5.0}, "wall": "sticky", "surface_tension": {"coefficient": 0.5}}
FUNNEL = {
    "solid": [
        {"shape": "capsule", "from": [0.0, 0.45], "to": [0.43, 0.2], "radius": 0.01},
        {"shape": "capsule", "from": [1.0, 0.45], "to": [0.6, 0.2], "radius": 0.01},
    ],
    "sand": [box([0.3, 0.27], [0.7, 0.45])],
}
SHELF = {
    "solid": [box([0.0, 0.1], [1.0, 0.108])],
    "sand": [box([0.6, 0.11], [1.0, 0.3], velocity=[1.0, 0.0])],
}
SCENES = {
    "flat": FLAT,
    "flip": DEEP
    | {"particles": {"transfer": "flip"}, "pressure": {"surface": "voxel"}, "wall": "free-slip"},
    "pic": FLAT | {"particles": {"transfer": "pic"}, "pressure": {"smoothing": 2}},
    "cut": DEEP
    | {"solid": [BALL], "liquid": [*DEEP["liquid"], DROP], "solver": {"precision": "double"}},
    "slivers": DEEP | {"solid": [BALL], "pressure": {"surface": "voxel"}},
    "voxel": DEEP | {"solid": [BALL], "solids": "voxel", "solver": {"tolerance": "auto"}},
    "turning": DEEP | {"solid": [BLADE], "output": {"forces": True}},
    "river": FLAT | RIVER,
    "whole-cell river": FLAT
    | RIVER
    | {"solid": [], "domain": OPEN | {"solids": "voxel"}, "pressure": {"surface": "voxel"}},
    "probes": DEEP | {"probe": PROBES, "solid": [BALL]},
    "probes, tilted": DEEP | TILTED | {"probe": PROBES, "pressure": {"surface": "voxel"}},
    "drops": DEEP | CAPILLARY | {"solid": [BALL], "liquid": [*DEEP["liquid"], DROP]},
    "crowded": DEEP
    | {"density_correction": {"every": 2}, "solid": [BALL], "liquid": [*DEEP["liquid"], DROP]},
    "reseeded": FLAT
    | {
        "particles": {"reseed": {"min": 4, "max": 4}},
        "solid": [DISC],
        "solver": {"precision": "double"},
    },
    "thick": DEEP | THICK,
    "thick and thin": DEEP
    | THICK
    | {"source": [SPOUT], "solid": [PLUNGER], "output": {"forces": True}},
    "thick letting go": FLAT
    | {"viscosity": {"value": 30.0, "slip_length": 0.02}, "liquid": [box([0.3, 0.1], [0.7, 0.5])]},
    "banded": POOL
    | {
        "particles": {"narrow_band": {"width": 3.0}, "reseed": {}, "transfer": "flip"},
        "solver": {"precision": "double"},
    },
    "unilateral": FLAT
    | {
        "pressure": {"model": "unilateral"},
        "solid": [DISC],
        "domain": OPEN,
        "solver": {"precision": "double"},
    },
    "floating": DEEP | FLOATING,
    "thrown": DEEP
    | {"liquid": THROWN, "particles": {"transfer": "flip"}, "solver": {"precision": "double"}},
    "rafts": FLAT
    | {
        "solid": RAFTS,
        "density_correction": {},
        "solver": {"precision": "double", "method": "minimum-map-newton"},
    },
    "coupled": FLAT | COUPLED | {"output": {"forces": True}},
    "coupled, open": FLAT
    | COUPLED
    | {"domain": OPEN | {"wall": "sticky"}, "liquid": [box([0.2, 0.0], [1.0, 0.3])]},
    "thick floating": DEEP | FLOATING | {"viscosity": {"value": 5.0}, "resolution": 24},
    "unilateral rafts": FLAT
    | {"solid": RAFTS, "pressure": {"model": "unilateral"}, "solver": {"precision": "double"}},
    "cup": FLAT | CUP,
    "bottle": FLAT | BOTTLE,
    "bottle shaken hard": FLAT | SHAKEN_HARD,
    "tub": DEEP | TUB,
    "sunken sheet": FLAT | SUNKEN,
    "thick cup": FLAT | CUP | THICK_CUP,
    "full": FLAT
    | {
        "liquid": [box([0.0, 0.0], [1.0, 0.5])],
        "wall": "free-slip",
        "physics": {"gravity": [0.0, 0.0]},
    },
}

SCENES |= {
    "sand": COLUMN | {"solid": [BALL], "density_correction": {}, "gauge": {"height": 0.1}},
    "stirred sand": COLUMN
    | {"solid": [THICK_BLADE], "source": [POURED], "particles": {"reseed": {"min": 4, "max": 12}}},
    "voxel sand": COLUMN
    | {"solid": [BALL], "solids": "voxel", "friction": {"dynamic_angle": 40.0, "grain_size": 1e-3}},
    "thrown sand": COLUMN | {"sand": THROWN},
    "endless sand": HEAP | SLOPE | {"solid": [DISC]},
    "endless sand, stirred": COLUMN | ROUND,
    "bodies in sand": COLUMN | {"solid": SUNK, "density_correction": {}},
    "ball on sand": HEAP | {"solid": DROPPED, "density_correction": {"every": 2}},
    "funnel": HEAP | FUNNEL,
    "endless shelf": HEAP | SLOPE | SHELF,
    "trickling sand": HEAP
    | TRICKLING
    | {"particles": {"transfer": "flip"}, "friction": {"model": "box"}},
}

# All ranks except one are empty at the start.
CORNER = {"size": [1.0, 0.5], "resolution": 32, "liquid": [box([0.0, 0.0], [0.2, 0.2])]}
PILE = {"size": [1.0, 0.5], "resolution": 32, "sand": CORNER["liquid"]}
AWAY = DISC | {"center": [0.7, 0.25]}  # a solid in the box of a rank without material
SHOWN = {"surface": True}
# Brings material to an empty rank.
LATE = box([0.7, 0.3], [0.8, 0.4], velocity=[0.5, 0.0], start=0.02)
BARE = {  # every stage of a step, with an empty rank
    "viscous": CORNER
    | {
        "viscosity": {"value": 50.0},
        "wall": "sticky",
        "solid": [AWAY],
        "output": SHOWN | {"forces": True},
    },
    "tension": CORNER
    | CAPILLARY
    | {"solid": [AWAY], "probe": PROBES_2D, "density_correction": {"every": 1}, "output": SHOWN},
    "dragged bodies": CORNER
    | {
        "solid": [AWAY | {"density": 500.0}],
        "wall_drag": {"coefficient": 0.1},
        "output": {"forces": True},
    },
    "viscous bodies": CORNER | {"solid": [AWAY | {"density": 500.0}], "viscosity": {"value": 5.0}},
    "band": CORNER
    | {"particles": {"narrow_band": {"width": 3.0}, "reseed": {}, "transfer": "flip"}},
    "unilateral": CORNER
    | {"pressure": {"model": "unilateral"}, "solid": [AWAY], "domain": OPEN, "source": [LATE]},
    "whole cells": CORNER
    | {
        "solids": "voxel",
        "pressure": {"surface": "voxel"},
        "solid": [AWAY],
        "solver": {"tolerance": "auto"},
    },
    "newton": CORNER
    | {"solver": {"method": "minimum-map-newton"}, "drain": [box([0.6, 0.0], [0.8, 0.2])]},
    "deep": {
        "size": [1.0, 0.4, 0.4],
        "resolution": 20,
        "liquid": [box([0.0, 0.0, 0.0], [0.2, 0.2, 0.2])],
        "output": {"volume": True},
    },
    "gone": CORNER
    | {"drain": [box([0.0, 0.0], [1.0, 0.5], start=0.02)], "density_correction": {"every": 1}},
    "in flight": CORNER | {"liquid": [box([0.05, 0.25], [0.15, 0.35], velocity=[1.0, 1.0])]},
    "pile": PILE
    | {
        "solid": [AWAY],
        "density_correction": {"every": 1},
        "gauge": {"height": 0.1},
        "output": SHOWN,
    },
    "bodies in a pile": PILE
    | {"solid": [AWAY | {"density": 500.0}], "particles": {"reseed": {"min": 4, "max": 4}}},
    "voxel pile": PILE
    | {"solid": [AWAY], "solids": "voxel", "source": [LATE], "friction": {"model": "box"}},
    "endless pile": PILE
    | UNCORRECTED
    | {"periodic": [True, False], "sand": [box([0.15, 0.0], [0.35, 0.2])]},
    "no pile": PILE
    | {
        "drain": [box([0.0, 0.0], [1.0, 0.5], start=0.02)],
        "open": ["right"],
        "particles": {"transfer": "flip"},
    },
    "thrown pile": PILE | {"sand": [box([0.05, 0.25], [0.15, 0.35], velocity=[1.0, 1.0])]},
}
BARE_STEPS = 4


def scene(**tables) -> ParticleScene:
    """Return a scene of liquid, or of sand."""
    return small_sands.scene(**tables) if "sand" in tables else small_liquids.scene(**tables)


def model(name: str) -> ParticleScene:
    """Return a scene."""
    return scene(**SCENES[name])


def advance(simulation, steps=STEPS):
    """Step, and return the rows of the log."""
    rows = []
    for _ in range(steps):
        dt = min(simulation.stable_dt(), DT)
        row = simulation.step(dt)
        measured = getattr(simulation, "measured", {})
        tables = {
            f"{table} {name}": value
            for table, found in measured.items()
            for name, value in found.items()
        }
        rows.append({"dt": dt, **row, **tables})
    return rows


def start(ranks: Ranks, name: str, **tables) -> ParticleSimulation:
    """Return a simulation on ranks."""
    return on_ranks(ranks, scene(**(SCENES[name] | tables)))


def on_ranks(ranks: Ranks, given: ParticleScene) -> ParticleSimulation:
    """Return the simulation of a scene on ranks."""
    return simulators()[given.scene.simulator].create(
        given, device="cpu", folder=Path(), ranks=ranks
    )


def run(ranks: Ranks, folder: Path) -> None:
    """Run all scenes, on four ranks with repartitions."""
    moved = []
    for name in SCENES:
        simulation = start(ranks, name)
        rows, cut = advance(simulation, 3), simulation.grid.part.decomposition.parts
        if ranks.size == 4:
            simulation.grid.part.balance = EAGER
        rows += advance(simulation, STEPS - 3)
        moved += [name] if simulation.grid.part.decomposition.parts != cut else []
        ranks.agree("the log", rows)
        frames = ranks.comm.allgather(list(simulation.frame()))
        assert sum(len(points.points) for points, *_ in frames) == rows[-1]["particles"]
        bodies = [part for _, _, *parts in frames for part in parts]
        # Of one rank.
        assert [part.name for part in bodies] == ["bodies"] * (simulation.bodies is not None)
        cells = np.concatenate([cells.index for _, cells, *_ in frames])
        assert len(np.unique(cells, axis=0)) == len(cells)
        box_ = simulation.grid.part.box
        assert (
            (frames[ranks.rank][1].index >= box_.low) & (frames[ranks.rank][1].index < box_.high)
        ).all()
        assert frames[ranks.rank][1].box == (box_.low, box_.high)
        pressure = np.concatenate([cells.fields["pressure"] for _, cells, *_ in frames])
        if ranks.is_root:
            order = np.lexsort(cells.T)
            np.savez(
                folder / f"{name}_{ranks.size}.npz", cells=cells[order], pressure=pressure[order]
            )
            (folder / f"{name}_{ranks.size}.json").write_text(json.dumps(rows))
    assert ranks.size != 4 or len(moved) > 9, moved


def bare(ranks: Ranks, folder: Path) -> None:
    """Run every stage of a step and of a frame with a rank without material.

    Continue in other boxes.
    """
    for name, tables in BARE.items():
        simulation = on_ranks(ranks, scene(**tables))
        assert ranks.size == 1 or ranks.any(simulation.particles.count == 0), name
        rows = advance(simulation, BARE_STEPS - 1)
        simulation.frame()
        boxes = simulation.grid.part.decomposition
        simulation.repartition(simulation.grid.part.repartition(boxes))
        rows += advance(simulation, 1)
        ranks.agree("the log", rows)
        if ranks.is_root:
            (folder / f"bare_{name}_{ranks.size}.json").write_text(json.dumps(rows))


def own_model(ranks: Ranks, folder: Path) -> None:
    """Run the documentation's model unchanged.

    Rank 0 has all of the sponge, or all ranks have some.
    """
    for name, tables in {"corner": CORNER, "flat": FLAT}.items():
        simulation = SIMULATOR.create(
            scene(**tables), device="cpu", folder=Path(), ranks=ranks, models=[sponge()(20.0, 0.1)]
        )
        rows = advance(simulation, BARE_STEPS)
        simulation.repartition(simulation.grid.part.repartition(simulation.grid.part.decomposition))
        rows += advance(simulation, 1)
        ranks.agree("the log", rows)
        if ranks.is_root:
            (folder / f"own_{name}_{ranks.size}.json").write_text(json.dumps(rows))


WRAPPED = {
    "flat": SCENES["flat"] | {"output": {"surface": True}, "solid": [DISC]},
    "coarse": SCENES["cut"]
    | {"output": {"surface": True, "surface_resolution": 1}, "resolution": 40},
    "heap": HEAP | {"output": {"surface": True}},
    "fine": SCENES["cut"] | {"output": {"surface": True, "surface_smoothing": 2.0, "volume": True}},
    "moving": SCENES["cut"] | {"output": {"surface": True, "volume": True, "volume_format": "vdb"}},
}


def single_volumes(parts: Sequence[Volume | VolumeGroup]) -> list[Volume]:
    """Return the volumes of a frame, those of groups too."""
    return [
        volume
        for part in parts
        for volume in (part.volumes if isinstance(part, VolumeGroup) else (part,))
    ]


def wrap(ranks: Ranks, folder: Path) -> None:
    """Write surfaces and volumes, at the start and later."""
    for name, tables in WRAPPED.items():
        simulation = on_ranks(ranks, scene(**tables))
        for step in range(2):
            advance(simulation, 2 * step)
            _, _, surface, *volumes = simulation.frame()
            assert ranks.is_root or not volumes
            pieces = [
                VtuMesh(part.points, part.corners, part.fields)
                for part in ranks.comm.allgather(surface)
            ]
            if ranks.is_root:
                mesh = one_mesh(pieces)
                found = {
                    f"volume_{volume.name}": volume.values for volume in single_volumes(volumes)
                } | mesh.fields
                np.savez(
                    folder / f"{name}_{step}_{ranks.size}.npz",
                    points=mesh.points,
                    corners=mesh.corners,
                    **found,
                )


RESUMED = (
    "cut",
    "river",
    "crowded",
    "floating",
    "thick and thin",
    "coupled",
    "banded",
    "sand",
    "stirred sand",
    "bodies in sand",
    "endless sand",
)


def keep(ranks: Ranks, folder: Path) -> None:
    """Run in two halves, and write the parts of the state between."""
    for name in RESUMED:
        simulation = start(ranks, name)
        simulation.grid.part.balance = EAGER
        first = advance(simulation, 5)
        np.savez(folder / f"{name}_piece_{ranks.rank}.npz", **simulation.state())
        rows = first + advance(simulation, 5)
        if ranks.is_root:
            (folder / f"{name}_whole.json").write_text(json.dumps(rows))
    ranks.comm.Barrier()  # all parts exist


def go_on(ranks: Ranks, folder: Path) -> None:
    """Continue from parts."""
    for name in reversed(RESUMED):
        pieces = [dict(np.load(file)) for file in sorted(folder.glob(f"{name}_piece_*.npz"))]
        simulation = start(ranks, name)
        simulation.grid.part.balance = EAGER
        simulation.restore_pieces(pieces)
        rows = advance(simulation, 5)
        if ranks.is_root:
            (folder / f"{name}_rest_{ranks.size}.json").write_text(json.dumps(rows))
    with pytest.raises(ValueError, match="do not cover the domain"):
        simulation.restore_pieces(pieces[1:])
    with pytest.raises(ValueError, match="differ from this scene's"):
        start(ranks, "flip").restore_pieces(pieces)


def fail(ranks: Ranks, folder: Path) -> None:
    """Fail on all ranks alike, with the state unchanged, and continue."""
    simulation = start(ranks, "cut", solver={"tolerance": 1e-9, "max_iterations": 1})
    before = simulation.state()
    with pytest.raises(StepFailed, match="MAX_ITERATIONS"):
        simulation.step(DT)
    after = simulation.state()
    assert simulation.step_count == 0
    assert (np.sort(before["place"]) == np.sort(after["place"])).all()
    sand = start(
        ranks, "sand", sand=[box([0.0, 0.1, 0.0], [0.5, 0.4, 0.5], velocity=[0.5, 0.0, 0.5])]
    )
    first = sand.step(1e-3)
    before = sand.own_state()
    with pytest.raises(StepFailed, match=r"sand would move .* cells, more than the ghost layers"):
        sand.step(0.5)
    assert (before["stress"] == sand.own_state()["stress"]).all()
    assert sand.step(1e-3)["particles"] == first["particles"]
    simulation = start(ranks, "cut")
    with pytest.raises(StepFailed, match="more than the ghost layers"):
        simulation.step(0.3)
    reference = advance(start(ranks, "cut"), 2)
    for row, expected in zip(advance(simulation, 2), reference, strict=True):
        # The solve starts from another guess.
        assert row["kinetic_energy"] == pytest.approx(expected["kinetic_energy"], rel=1e-3)
    if ranks.rank == ranks.size - 1 and simulation.particles.count:
        velocity = simulation.particles.velocity.numpy()
        velocity[3] = np.nan
        simulation.particles.velocity.assign(velocity)
    with pytest.raises(
        SimulationFailed, match=r"velocity is not finite in cell .* \(1 particles\)"
    ) as failed:
        simulation.step(DT)
    ranks.agree("the message", str(failed.value))


def launches(ranks: Ranks, folder: Path) -> None:
    """Count launches and exchanges of a step of sand from Python.

    There are as many with four times the iterations of the stress solve.
    """
    for name in ("trickling sand", "ball on sand"):
        found = []
        for least in (100, 400):
            # Met whenever the residual is tested.
            simulation = start(ranks, name, solver={"tolerance": 0.9})
            advance(simulation, 3)
            simulation.method = HeavyBallProjectedGradient(least=least, cold=least)
            with (
                patch.object(
                    ThreadPool, "run", autospec=True, side_effect=ThreadPool.run
                ) as tables,
                patch.object(wp, "launch", wraps=wp.launch) as single,
            ):
                exchanges = waiting._count
                (row,) = advance(simulation, 1)
                exchanges = waiting._count - exchanges
            assert row["solve_iterations"] == least, name
            found.append((tables.call_count, single.call_count, exchanges))
        assert found[0] == found[1], (name, found)
        assert found[0][0] < 50, (name, found)


def dam(ranks: Ranks, folder: Path) -> None:
    """Run the built-in scene."""
    simulation = on_ranks(ranks, load_scene("dam-break"))
    rows = advance(simulation, DAM_STEPS)
    if ranks.is_root:
        (folder / "dam.json").write_text(json.dumps(rows))


def differ(ranks: Ranks, folder: Path) -> None:
    """Refuse scenes that differ between ranks."""
    with pytest.raises(ValueError, match="the scene on rank 1 differs from rank 0"):
        start(ranks, "flat", time={"duration": 1.0 + ranks.rank})


if __name__ == "__main__":
    world = Ranks.world()
    for what in sys.argv[1].split(","):
        {
            "run": run,
            "keep": keep,
            "go-on": go_on,
            "fail": fail,
            "launches": launches,
            "differ": differ,
            "dam": dam,
            "wrap": wrap,
            "bare": bare,
            "own-model": own_model,
        }[what](world, Path(sys.argv[2]))
