"""Messages of `check` before a run.

It refuses what a run refuses before its first step, gives the messages of a run's start, and does
not underestimate the number of particles.
"""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from command_line import invoke
from particle_scenes import particle_scenes
from warp_lcp.cli import commands as cli
from warp_lcp.run.check import check_scene, start
from warp_lcp.run.stepping import take_step
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import MOST_TABLES, load_scene
from warp_lcp.scene.table import SceneError

LIQUID = {"shape": "box", "min": [0.0, 0.0], "max": [1.0, 0.3]}
FILLS = {"shape": "box", "min": [-1.0, -1.0], "max": [2.0, 2.0]}
BEAM = {"shape": "box", "min": [0.4, 0.55], "max": [0.9, 0.65]}


def written(
    path: Path, shapes: list[dict[str, Any]], *, simulator: str = "fluids", **tables: Any
) -> Path:
    data = {
        "scene": {"simulator": simulator},
        "time": {"duration": 0.5},
        "domain": {"size": [1.0, 1.0], "resolution": 16, **tables.pop("domain", {})},
        "liquid" if simulator == "fluids" else "sand": shapes,
        **tables,
    }
    path.write_bytes(tomli_w.dumps(data).encode())
    return path


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"solid": [FILLS]}, "the solids fill the whole domain"),
        ({"solid": [FILLS], "domain": {"solids": "voxel"}}, "the solids fill the whole domain"),
        (
            {"solid": [{"shape": "plane", "point": [0.0, 0.5], "normal": [0.0, 1.0]}]},
            r"liquid\[0\] \(box\) holds no particle",
        ),
        (
            {
                "source": [
                    {
                        "shape": "sphere",
                        "center": [0.5, 0.5],
                        "radius": 0.01,
                        "velocity": [0.0, -1.0],
                    }
                ]
            },
            "holds no open cell's center",
        ),
        (
            {"solid": [{"shape": "sphere", "center": [3.0, 0.5], "radius": 0.1}]},
            "lies wholly outside the domain",
        ),
    ],
)
def test_check_and_run_refuse_a_scene_with_the_same_message(
    tables: dict[str, Any], message: str, tmp_path: Path
) -> None:
    scene, out = written(tmp_path / "scene.toml", [LIQUID], **tables), tmp_path / "out"
    checked, ran = (
        invoke("check", scene, "--device", "cpu"),
        invoke("run", scene, "--device", "cpu", "--out", out),
    )
    assert checked.exit_code == ran.exit_code == cli.WRONG_INPUT
    with pytest.raises(SceneError, match=message):
        start(load_scene(scene), "cpu")
    assert checked.stderr and ran.stderr.endswith(checked.stderr)


def test_both_name_the_shape_whose_mesh_is_open(tmp_path: Path) -> None:
    (tmp_path / "sheet.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    pool = {"shape": "box", "min": [0.0, 0.0, 0.0], "max": [1.0, 0.3, 1.0]}
    domain, solid = {"size": [1.0, 1.0, 1.0]}, [{"shape": "mesh", "file": "sheet.obj"}]
    scene = written(tmp_path / "scene.toml", [pool], domain=domain, solid=solid)
    for result in (invoke("check", scene), invoke("run", scene, "--out", tmp_path / "out")):
        assert result.exit_code == cli.WRONG_INPUT
        assert re.search(r"solid\[0\]: \S*sheet.obj: the surface is not closed", result.stderr)


def test_check_says_what_a_run_says(tmp_path: Path) -> None:
    mesh = tmp_path / "mesh.obj"
    corners = [[x, y, z] for z in (-0.2, 0.2) for y in (0.4, 0.8) for x in (0.4, 0.8)]
    faces = [
        [1, 3, 4, 2],
        [5, 6, 8, 7],
        [1, 2, 6, 5],
        [3, 7, 8, 4],
        [1, 5, 7, 3],
        [2, 4, 8, 6],
        [2, 4, 8, 6],
    ]
    lines = [
        *("v " + " ".join(map(str, corner)) for corner in corners),
        *("f " + " ".join(map(str, face)) for face in faces),
    ]
    mesh.write_text("\n".join(lines))
    scene = written(tmp_path / "scene.toml", [LIQUID], solid=[{"shape": "mesh", "file": str(mesh)}])
    shown = invoke("check", scene, "--device", "cpu")
    assert shown.exit_code == 0
    assert f"{mesh}: dropped 2 repeated triangles, the first at [" in shown.stdout
    assert " particles, 16 x 16 cells" in shown.stdout


# --- particles ---


def most_particles(scene: Scene, steps: int) -> tuple[int, int]:
    simulation = start(scene, "cpu")
    first = most = simulation.particles.count  # type: ignore[attr-defined]
    for _ in range(steps):
        take_step(simulation, simulation.stable_dt(), scene.time.duration, scene.time)
        most = max(most, simulation.particles.count)  # type: ignore[attr-defined]
    return first, most


def assert_foretold(scene: Scene, steps: int) -> None:
    first, most = most_particles(scene, steps)
    assert first <= scene.particle_estimate(later=False)  # type: ignore[attr-defined]
    assert most <= scene.particle_estimate()  # type: ignore[attr-defined]


def generated(chance: random.Random) -> dict[str, Any]:
    """Return a scene of boxes and balls anywhere, with or without sources."""

    def shape() -> dict[str, Any]:
        low = [chance.uniform(0.0, 0.7), chance.uniform(0.0, 0.7)]
        box = {
            "shape": "box",
            "min": low,
            "max": [low[0] + chance.uniform(0.1, 0.4), low[1] + chance.uniform(0.1, 0.4)],
        }
        center = [chance.uniform(0.2, 0.8), chance.uniform(0.2, 0.8)]
        return chance.choice(
            [box, box, {"shape": "sphere", "center": center, "radius": chance.uniform(0.08, 0.2)}]
        )

    sources = [
        {**shape(), "velocity": chance.choice([[0.0, -2.0], [1.0, -1.0], [-3.0, 0.0]])}
        for _ in range(chance.choice([0, 1, 2]))
    ]
    particles = {
        "per_axis": chance.choice([1, 2, 3]),
        "jitter": chance.choice([0.0, 0.25, 0.5, 1.0]),
    }
    return {"material": [shape()], "source": sources, "particles": particles}


@pytest.mark.parametrize("seed", range(4420, 4430))
def test_no_more_particles_than_estimated(seed: int, tmp_path: Path) -> None:
    tables = generated(random.Random(seed))
    assert_foretold(
        load_scene(written(tmp_path / "scene.toml", tables.pop("material"), **tables)), 3
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", particle_scenes())
def test_no_more_particles_than_estimated_in_built_in_scenes(name: str) -> None:
    assert_foretold(load_scene(name), 10)


def test_particles_of_a_narrow_band_are_estimated(tmp_path: Path) -> None:
    lines = dict(check_scene("dam-break-2d", ["particles.narrow_band.width=4.0"])[1])
    assert lines["particles"].startswith("about ")
    assert dict(check_scene("dam-break-2d")[1])["particles"].startswith("at most 3,456, ")


def test_too_many_shapes_are_refused_before_they_are_read(tmp_path: Path) -> None:
    scene = written(tmp_path / "scene.toml", [LIQUID] * (MOST_TABLES + 1))
    with pytest.raises(SceneError, match=r"liquid: has 10,001 entries: at most 10,000 are allowed"):
        load_scene(scene)


# --- angles ---


def test_rotate_turns_about_the_origin_or_the_point_that_is_named(tmp_path: Path) -> None:
    center = [0.65, 0.6]
    turned = load_scene(
        written(tmp_path / "a.toml", [LIQUID], solid=[{**BEAM, "rotate": 90.0, "about": center}])
    ).solid[0]
    box = turned.bounds(2)
    assert box is not None
    np.testing.assert_allclose(box[:, :2], [[0.6, 0.35], [0.7, 0.85]], atol=1e-12)
    larger = (
        load_scene(
            written(tmp_path / "b.toml", [LIQUID], solid=[{**BEAM, "scale": 1.1, "about": center}])
        )
        .solid[0]
        .bounds(2)
    )
    assert larger is not None
    np.testing.assert_allclose(larger[:, :2].mean(axis=0), center, atol=1e-12)
    with pytest.raises(
        SceneError,
        match=r"solid\[0\]\.about = \[0\.65, 0\.6\]: has no effect without rotate or scale",
    ):
        load_scene(written(tmp_path / "c.toml", [LIQUID], solid=[{**BEAM, "about": center}]))


def test_a_shape_rotated_out_of_the_domain_is_reported(tmp_path: Path) -> None:
    scene = load_scene(written(tmp_path / "scene.toml", [LIQUID], solid=[{**BEAM, "rotate": 45.0}]))
    (note,) = scene.notes()
    assert (
        note
        == "solid[0] (box): rotate about the origin moves it 0.1768 m out of the domain; to rotate "
        "it about its center, set " + ("about = [0.65, 0.6]")
    )
    assert note in start(scene, "cpu").notes()
    assert not load_scene(
        written(
            tmp_path / "b.toml", [LIQUID], solid=[{**BEAM, "rotate": 45.0, "about": [0.65, 0.6]}]
        )
    ).notes()


@pytest.mark.parametrize(
    ("phase", "hint"),
    [(1.5708, "90"), (-3.1416, "-180"), (90.0, None), (-90.0, None), (0.0, None), (1.5, None)],
)
def test_a_phase_in_radians_is_reported(phase: float, hint: str | None, tmp_path: Path) -> None:
    motion = {"kind": "sinusoid", "period": 1.0, "amplitude": [0.1, 0.0], "phase": phase}
    notes = load_scene(
        written(tmp_path / "scene.toml", [LIQUID], solid=[{**BEAM, "motion": motion}])
    ).notes()
    assert notes == (
        []
        if hint is None
        else [
            f"solid[0].motion.phase = {phase:g} is in degrees; if radians were meant, it is {hint}"
        ]
    )


# --- sand ---


@pytest.mark.parametrize(
    ("sand", "material", "key"),
    [
        ({"friction_angle": 51.0}, {}, r"sand\[0\]\.friction_angle = 51\.0: must be at most 50\.7"),
        ({}, {"friction_angle": 51.0}, r"material\.friction_angle = 51\.0: must be at most 50\.7"),
        (
            {},
            {"name": "gravel", "friction_angle_test": "triaxial-compression"},
            r'material\.name = "gravel": has a friction angle of 40 degrees',
        ),
    ],
)
def test_a_friction_angle_is_refused_under_its_own_key(
    sand: dict[str, Any], material: dict[str, Any], key: str, tmp_path: Path
) -> None:
    domain = {"size": [1.0, 1.0, 1.0]} if "friction_angle_test" in material else {}
    box = {**LIQUID, "min": [0.0] * 3, "max": [1.0, 0.3, 1.0]} if domain else LIQUID
    with pytest.raises(SceneError, match=key):
        load_scene(
            written(
                tmp_path / "scene.toml",
                [{**box, **sand}],
                simulator="granular",
                domain=domain,
                material=material,
            )
        )


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        (
            {"solid": [{**BEAM, "rotate": 10.0, "density": 3000.0, "about": [0.65, 0.6]}]},
            "because sand moves some of them",
        ),
        (
            {
                "solid": [{**BEAM, "rotate": 10.0, "about": [0.65, 0.6]}],
                "domain": {"periodic": [True, False]},
            },
            "because an axis is periodic",
        ),
        (
            {
                "solid": [{**BEAM, "rotate": 10.0, "about": [0.65, 0.6]}],
                "solver": {"method": "interleaved-sweeps"},
            },
            'is "interleaved-sweeps"',
        ),
        ({"solid": [{**BEAM, "rotate": 10.0, "about": [0.65, 0.6]}]}, None),
    ],
)
def test_sand_says_where_solids_stay_whole_cells(
    extra: dict[str, Any], reason: str | None, tmp_path: Path
) -> None:
    scene = written(tmp_path / "scene.toml", [LIQUID], simulator="granular", **extra)
    notes = [note for note in start(load_scene(scene), "cpu").notes() if "whole cells" in note]
    assert [reason in note for note in notes] == ([] if reason is None else [True])


def test_thin_meshes_of_whole_cells_are_said_to_let_their_own_material_pass(tmp_path: Path) -> None:
    """With cut cells they hold, and nothing is said."""
    solid = {"shape": "mesh", "file": "builtin:torus", "scale": 0.2, "translate": [0.5, 0.6]}
    for simulator, word in (("fluids", "liquid"), ("granular", "sand")):
        for solids, passes in (("voxel", True), ("cut-cell", False)):
            file = tmp_path / f"{simulator}-{solids}.toml"
            scene = written(
                file, [LIQUID], simulator=simulator, domain={"solids": solids}, solid=[solid]
            )
            assert (
                any(
                    f": {word} may pass there" in note
                    for note in start(load_scene(scene), "cpu").notes()
                )
                == passes
            )
