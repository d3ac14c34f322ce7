"""Liquids and sands on ranks: log, frames and failures of one process."""

import functools
import json
from pathlib import Path

import liquids_on_ranks
import numpy as np
import pytest
from liquids_on_ranks import (
    BARE,
    BARE_STEPS,
    COLUMN,
    CORNER,
    DAM_STEPS,
    FLAT,
    HEAP,
    RESUMED,
    SCENES,
    WRAPPED,
    advance,
    model,
    scene,
    single_volumes,
    sponge,
)
from ranks_in_turn import RankInTurn
from scipy.spatial import cKDTree

from small_liquids import box
from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.ghost_width import displacement_beyond_ghosts
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids import SIMULATOR
from warp_lcp.material.particle_pieces import fields_of
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

PROGRAM = Path(__file__).with_name("liquids_on_ranks.py")
TESTS = Path(__file__).parents[1]
SANDS = (
    "bodies in sand",
    "ball on sand",
    "sand",
    "stirred sand",
    "voxel sand",
    "trickling sand",
    "endless sand",
    "endless sand, stirred",
    "funnel",
    "endless shelf",
)


def solve_noise(row):
    """Return what rounding of `solve_residual` is compared with.

    Of sand it is the ratio of `coupled_residual` to that at the start of the solve. After a coupled
    solve of velocity and pressure the start is what that solve has left, its error.
    """
    left = row.get("coupled_residual") or (row.get("stokes_iterations") and row["stokes_error"])
    return max(1.0, row["solve_residual"] / (left or 1.0))


# The remaining residual is as small as the rounding of the solve. It is compared with the quantity
# of which it is a small part.
NOISE = {
    **dict.fromkeys(
        ("viscous_residual", "coupled_residual", "predicted_excess", "stokes_error"),
        lambda row: 1.0,
    ),
    "solve_residual": solve_noise,
    # v = sqrt(e / 8) at least, for an error e of the stresses in the units of `coupled_residual`:
    # dv = de / (16 v), see `Stress.take_residual`.
    "velocity_error": lambda row: 1.0 / (16.0 * max(row["velocity_error"], 1e-4)),
    "max_divergence": lambda row: 32.0 * max(row["max_speed"], 0.1),
    # A difference of positions in float32, in a domain of about 1 m.
    "runout": lambda row: 1.0,
}


# With a solver in double precision only the order of its sums differs; sometimes that changes the
# last bit of a velocity. Bodies in contact amplify it: the last bit of a thousandth of all
# velocities, changed in one process, turns the box on the floor by 4e-6 of 90 degrees per second.
# Beside a periodic side that is cut, particles are summed in another order, and from the other side
# with other last bits. Such bits, changed after each step in one process, make 4e-6 of the
# dissipation.
CLOSE = {
    "cut": 1e-8,
    "floating": 1e-5,
    "ball on sand": 1e-5,
    "bodies in sand": 1e-5,
    "endless sand": 2e-5,
    "endless sand, stirred": 2e-5,
    "endless shelf": 2e-5,
    # Liquid nearly at rest: its kinetic energy is the square of such differences.
    "cup": 1e-5,
    "bottle": 1e-5,
    "bottle shaken hard": 1e-5,
    "tub": 1e-5,
}


def same(rows, expected, rel):
    """Assert that two logs are equal up to rounding.

    Numbers of all kinds are compared.
    """
    assert len(rows) == len(expected)
    for row, other in zip(rows, expected, strict=True):
        assert row.keys() == other.keys()
        # Components may be almost 0.
        scales = {"forces ": 9.81 * other["mass"], "probes velocity": other["max_speed"]}
        scales |= {f"body{n}_{turn}": 90.0 for n in range(3) for turn in ("w", "spin", "angle")}
        scales |= {f"body{n}_v": other["max_speed"] for n in range(3)}
        for name, value in other.items():
            scale = next((scale for begin, scale in scales.items() if name.startswith(begin)), None)
            if value is None:
                assert row[name] is None, name
            elif scale is not None and isinstance(value, float) and value == value:
                assert abs(row[name] - value) <= max(rel, 1e-7) * scale, name
            elif name in NOISE:
                last_bit = 1e-7 if rel else 0.0  # last bit of a velocity, in float32
                assert abs(row[name] - value) <= max(rel, last_bit) * NOISE[name](other), name
            elif isinstance(value, float):
                assert row[name] == pytest.approx(value, rel=rel, abs=1e-12, nan_ok=True), name
            else:
                assert row[name] == value, name


def single(model_) -> ParticleSimulation:
    """Return a simulation in one process."""
    return simulators()[model_.scene.simulator].create(model_, device="cpu", folder=Path())


def alone(model_, **options):
    """Return a simulation on one rank, which needs no MPI."""
    return simulators()[model_.scene.simulator].create(
        model_, device="cpu", folder=Path(), ranks=Ranks(RankInTurn(0, 1)), **options
    )


ONE_RANK = (
    "floating",
    "rafts",
    "thick floating",
    "unilateral rafts",
    "flat",
    "cut",
    "voxel",
    "turning",
    "river",
    "whole-cell river",
    "drops",
    "crowded",
    "reseeded",
    "thick and thin",
    "coupled",
    "coupled, open",
    "banded",
    "cup",
    "bottle",
    "bottle shaken hard",
    "tub",
    "sunken sheet",
    "thick cup",
)


@pytest.mark.parametrize("name", [*ONE_RANK, "unilateral", *SANDS])
def test_one_rank_is_one_process_bit_for_bit(name):
    one, shared = single(model(name)), alone(model(name))
    rows = advance(one, 6)
    assert advance(shared, 6) == rows
    assert not name.startswith("coupled") or all(row["stokes_iterations"] for row in rows)
    state, piece = one.state(), shared.state()
    for array in shared.particles.arrays():
        np.testing.assert_array_equal(piece[array], state[array])
    for array, field in fields_of(state).items():
        np.testing.assert_array_equal(piece[array], field[..., 1:-1, 1:-1, 1:-1])
    assert shared.notes()[0] == one.notes()[0]
    for part, expected in zip(shared.frame(), one.frame(), strict=True):
        np.testing.assert_array_equal(
            getattr(part, "index", None), getattr(expected, "index", None)
        )
        for field, values in expected.fields.items():
            np.testing.assert_array_equal(part.fields[field], values)


@pytest.fixture(scope="module")
def logs():
    """Logs of one process, and the pressures in its last frames."""
    found = {}
    for name in SCENES:
        simulation = single(model(name))
        rows = advance(simulation)
        cells = simulation.frame()[1]
        order = np.lexsort(cells.index.T)
        found[name] = rows, cells.index[order], cells.fields["pressure"][order]
    return found


@pytest.fixture(scope="module")
def done(mpi_of_module):
    """Return a function of n that runs the program on n ranks and returns the folder of its logs.

    The program runs once for each n, with all the cases that tests need on n ranks.
    """
    wanted = {2: "run,bare,own-model,fail,differ,launches", 3: "bare,own-model", 4: "run"}

    @functools.cache
    def on(ranks):
        mpi_of_module(
            ranks,
            PROGRAM,
            wanted[ranks],
            ".",
            environment={"PYTHONPATH": f"{TESTS}:{TESTS.parent}"},
            seconds=400.0,
        )
        return mpi_of_module.folder

    return on


@pytest.mark.parametrize("ranks", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_ranks_have_the_log_and_the_pressure_of_one_process(done, logs, ranks):
    folder = done(ranks)
    for name, (rows, cells, pressure) in logs.items():
        same(json.loads((folder / f"{name}_{ranks}.json").read_text()), rows, CLOSE.get(name, 1e-6))
        saved = np.load(folder / f"{name}_{ranks}.npz")
        np.testing.assert_array_equal(saved["cells"], cells)
        np.testing.assert_allclose(saved["pressure"], pressure, atol=1e-5 * np.abs(pressure).max())


@pytest.mark.parametrize("ranks", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_rank_without_material_takes_every_stage(done, ranks):
    folder = done(ranks)
    for name, tables in BARE.items():
        rows = advance(single(scene(**tables)), BARE_STEPS)
        same(json.loads((folder / f"bare_{name}_{ranks}.json").read_text()), rows, 1e-5)
    for name, tables in {"corner": CORNER, "flat": FLAT}.items():  # the documentation's own model
        rows = advance(
            SIMULATOR.create(
                scene(**tables), device="cpu", folder=Path(), models=[sponge()(20.0, 0.1)]
            ),
            BARE_STEPS + 1,
        )
        assert rows[-1]["sponge_work"] > 0.0
        same(json.loads((folder / f"own_{name}_{ranks}.json").read_text()), rows, 1e-5)


@pytest.mark.parametrize("ranks", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_ranks_have_the_surface_and_the_volumes_of_one_process(mpi, tmp_path, ranks):
    """Surface and volumes on ranks against one process.

    Bit for bit before rounding differs: the same triangles, with points on cuts once.
    """
    mpi(ranks, PROGRAM, "wrap", tmp_path, environment={"PYTHONPATH": f"{TESTS}:{TESTS.parent}"})
    for name, tables in WRAPPED.items():
        simulation = single(scene(**tables))
        for step in range(2):
            advance(simulation, 2 * step)
            _, _, expected, *volumes = simulation.frame()
            found = np.load(tmp_path / f"{name}_{step}_{ranks}.npz")
            for volume in single_volumes(volumes):
                atol = (1e-4 if volume.name == "velocity" else 1e-6) * step
                values = found[f"volume_{volume.name}"]
                np.testing.assert_allclose(values, volume.values, atol=atol)
            order, other = (np.lexsort(part.T) for part in (found["points"], expected.points))
            velocity = expected.fields["velocity"]
            if step == 0:
                np.testing.assert_array_equal(found["points"][order], expected.points[other])
                np.testing.assert_array_equal(found["velocity"][order], velocity[other])
                places = [np.empty_like(numbers) for numbers in (order, other)]
                for place, numbers in zip(places, (order, other), strict=True):
                    place[numbers] = np.arange(len(numbers))
                corners = [
                    rolled(place[part])
                    for place, part in zip(
                        places, (found["corners"], expected.corners), strict=True
                    )
                ]
                np.testing.assert_array_equal(*corners)
            assert found["points"].shape == expected.points.shape
            assert found["corners"].shape == expected.corners.shape
            far, nearest = cKDTree(found["points"]).query(expected.points)
            assert far.max() < 2e-6
            np.testing.assert_allclose(found["velocity"][nearest], velocity, atol=1e-4)


def rolled(corners):
    """Return triangles or segments in one order, from their lowest corners on."""
    turn = corners.argmin(axis=1) if corners.shape[1] == 3 else np.zeros(len(corners), dtype=int)
    turned = np.take_along_axis(
        corners, (turn[:, None] + np.arange(corners.shape[1])) % corners.shape[1], axis=1
    )
    return turned[np.lexsort(turned.T)]


@pytest.mark.slow
def test_a_dam_break_has_the_log_of_one_process(mpi, tmp_path):
    """Log of a dam break on ranks against one process.

    The last bit of a thousandth of all velocities, changed once in one process, makes up to 1.7e-6
    of a column in these steps.
    """
    assert (
        mpi(
            2,
            PROGRAM,
            "dam",
            tmp_path,
            environment={"PYTHONPATH": f"{TESTS}:{TESTS.parent}"},
            seconds=300.0,
        ).returncode
        == 0
    )
    rows = advance(single(load_scene("dam-break")), DAM_STEPS)
    same(json.loads((tmp_path / "dam.json").read_text()), rows, 3e-6)


@pytest.mark.slow
def test_a_run_goes_on_on_any_number_of_ranks(mpi, tmp_path):
    environment = {"PYTHONPATH": f"{TESTS}:{TESTS.parent}"}
    for ranks, what in ((2, "keep,go-on"), (4, "go-on")):
        assert mpi(ranks, PROGRAM, what, tmp_path, environment=environment).returncode == 0
    liquids_on_ranks.go_on(Ranks(RankInTurn(0, 1)), tmp_path)
    for name in RESUMED:
        whole = json.loads((tmp_path / f"{name}_whole.json").read_text())[5:]
        for ranks in (1, 2, 4):
            found = json.loads((tmp_path / f"{name}_rest_{ranks}.json").read_text())
            same(found, whole, 0.0 if ranks == 2 else CLOSE.get(name, 1e-6))


def test_failures_are_those_of_all_ranks_and_steps_of_stresses_need_no_python(done):
    assert done(2)  # by `fail`, `differ` and `launches`, which fail if they are not


def test_pieces_of_any_boxes_can_be_read():
    simulation = alone(model("flat"))
    advance(simulation, 3)
    whole = simulation.state()
    pieces = []
    for low, high in ((0, 13), (13, 32)):
        # Some have not moved to another rank yet.
        mine = (whole["position"][:, 0] < 0.55) if low == 0 else (whole["position"][:, 0] >= 0.55)
        part = {
            name: values[mine]
            for name, values in whole.items()
            if name[:6] in ("positi", "veloci", "affine", "place")
        }
        fields = {name: whole[name][:, :, low:high] for name in ("pressure", "cells", "contact")}
        pieces.append(whole | part | fields | {"box": np.array([[low, 0, 0], [high, 16, 1]])})
    again = alone(model("flat"))
    again.restore_pieces(pieces[::-1])
    for name, values in again.state().items():
        np.testing.assert_array_equal(values, whole[name])
    assert advance(again, 3) == advance(simulation, 3)


def test_a_source_keeps_its_cells_in_other_boxes_wherever_bodies_are():
    falling = box([0.1, 0.3], [0.2, 0.4], density=1000.0)
    source = box([0.05, 0.41], [0.25, 0.5], velocity=[0.0, -1.0])
    simulation = alone(scene(**(HEAP | {"solid": [falling], "source": [source]})))
    advance(simulation, 10)
    cells, bodies = simulation.sources._cells, simulation.bodies.state()["bodies"]
    simulation._work_on(simulation.grid.part.repartition(simulation.grid.part.decomposition))
    np.testing.assert_array_equal(simulation.sources._cells, cells)
    np.testing.assert_array_equal(simulation.bodies.state()["bodies"], bodies)


def test_too_large_velocities_are_detected_near_and_along_cuts():
    part = Subdomain(
        Decomposition((40, 8, 1), Ranks(RankInTurn(0, 2))),
        spacing=0.1,
        dimension=2,
        device="cpu",
        layers=5,
    )
    for axis, place, cells, expected in (
        (0, 21, 3.9, 0.0),  # as far as the layers reach, except one
        (0, 21, -4.2, 4.2),
        (0, 25, 4.2, 4.2),  # in a ghost layer
        (0, 8, 4.2, 0.0),  # deep in the box
        (0, 8, 40.0, 40.0),
        (1, 21, 40.0, 0.0),  # along the cut
        (0, 21, np.nan, 0.0),
    ):
        velocity = part.grid.faces()
        host = velocity[axis].numpy()
        host[1, 4, place] = cells * 0.1 / 0.02
        assert displacement_beyond_ghosts(part, velocity, 0.02) == pytest.approx(expected, rel=1e-5)


def damaged(name, change):
    """Return a part of the state with one change."""
    simulation = alone(model(name))
    advance(simulation, 1)
    piece = dict(simulation.state())
    change(piece)
    return simulation, piece


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.pop("place"), "lacks place"),
        (lambda p: p.update(signature=p["signature"] + 1), "differ from this scene's"),
        (lambda p: p.update(box=np.array([[0, 0, 0], [31, 16, 1]])), "do not cover the domain"),
        (lambda p: p["velocity"].__setitem__((3, 0), np.nan), "not finite"),
        (lambda p: p["cells"].__setitem__((0, 3, 4), 2), "solids are not this scene's"),
        (
            lambda p: p.update(
                {n: p[n][1:] for n in ("position", "velocity", "affine_0", "affine_1", "place")}
            ),
            "927 particles.*928",
        ),
    ],
)
def test_checkpoint_parts_of_another_scene_are_refused(change, message):
    simulation, piece = damaged("flat", change)
    with pytest.raises(ValueError, match=message):
        simulation.restore_pieces([piece])


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        (
            COLUMN | {"periodic": [False, False, True], "output": {"surface": True}},
            "output.surface where an axis is periodic",
        ),
        (
            COLUMN | {"periodic": [False, False, True]},
            r"the density correction where an axis is periodic \(density_correction.every = 0 "
            r"switches it off\)",
        ),
    ],
)
def test_features_unsupported_on_ranks_are_refused_by_name(tables, key):
    with pytest.raises(ValueError, match=f"{key}.* is not there on several processes"):
        alone(scene(**tables))


def test_methods_of_one_process_are_refused_by_name():
    with pytest.raises(
        ValueError,
        match=r"solver\.method = psor works on one process only.*: projected-multigrid or "
        r"minimum-map-newton",
    ):
        alone(scene(**(FLAT | {"solver": {"method": "psor"}})))
    with pytest.raises(
        ValueError,
        match=r"solver\.method = interleaved-sweeps works on one process only.*: "
        r"accelerated-projection",
    ):
        alone(scene(**(HEAP | {"solver": {"method": "interleaved-sweeps"}})))


def test_liquid_without_a_particle_is_refused():
    with pytest.raises(ValueError, match=r"liquid\[1\] \(box\) holds no particle"):
        alone(scene(**(FLAT | {"liquid": [*FLAT["liquid"], box([0.1, 0.1], [0.2, 0.2])]})))
