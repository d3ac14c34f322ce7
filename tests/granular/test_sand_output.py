"""Output of runs of sand, and messages of the command line."""

import csv
import json
from pathlib import Path

import meshio
import numpy as np
import pytest

from command_line import invoke
from small_sands import box, create, scene
from warp_lcp.render.image_content import Color
from warp_lcp.render.recording import Recording

SMALL = ["--set", "domain.resolution=24", "--set", "time.duration=0.1", "--device", "cpu"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a short run of the column, with its profile."""
    out = tmp_path_factory.mktemp("sand") / "run"
    result = invoke("run", "column-collapse-2d", "--out", out, *SMALL, "--profile")
    assert result.exit_code == 0, result.output
    return Path(out)


def test_the_log_has_the_columns_of_sand(folder: Path) -> None:
    with open(folder / "log.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    for name in (
        "coupled_residual",
        "velocity_error",
        "staggering_iterations",
        "yielded",
        "dissipation",
        "predicted_excess",
        "front",
        "max_fraction",
        "runout",
        "height",
    ):
        assert all(np.isfinite(float(row[name])) for row in rows)
    assert {row["solver"] for row in rows} == {"accelerated-projection"}
    assert float(rows[-1]["runout"]) > float(rows[0]["runout"])
    assert float(rows[-1]["front"]) > float(rows[0]["front"])
    assert float(rows[-1]["height"]) < float(rows[0]["height"])
    assert {"density_status", "max_density"} <= rows[0].keys()
    assert "flow_rate" not in rows[0]


def test_frames_have_the_stresses_of_sand(folder: Path) -> None:
    last = sorted(folder.glob("frames/particles_*.vtu"))[-1]
    points = meshio.read(last)
    assert points.point_data.keys() >= {"velocity", "speed", "fraction", "pressure", "yield_ratio"}
    assert 0.0 < points.point_data["fraction"].max() < 0.75  # of space: 0.6 at the densest packing
    assert points.point_data["pressure"].min() >= 0.0
    assert 0.0 < points.point_data["yield_ratio"].max() <= 1.01
    cells = meshio.read(str(last).replace("particles", "grid"))
    assert cells.cell_data.keys() >= {"fraction", "pressure", "yield_ratio"}
    count = len(cells.cells[0].data)
    assert all(len(values[0]) == count for values in cells.cell_data.values())


def test_the_profile_has_the_stages_of_a_step(folder: Path) -> None:
    stages = json.loads((folder / "profile.json").read_text(encoding="utf-8"))
    text = json.dumps(stages)
    for stage in ("packing", "stress", "extrapolation", "particles-to-grid", "density correction"):
        assert stage in text


@pytest.mark.parametrize(
    ("color", "label"),
    [
        (Color.FRACTION, "fraction of grains"),
        (Color.YIELD_RATIO, "yield ratio"),
        (Color.PRESSURE, "pressure [Pa]"),
    ],
)
def test_images_may_show_the_stresses_of_sand(folder: Path, color: Color, label: str) -> None:
    recording = Recording(folder, color)
    points, values = recording.read(recording.numbers[-1])
    assert len(points) == len(values) > 0
    scale = recording.scale
    assert scale.label == label
    assert scale.low == 0.0 < scale.high


def test_sand_has_colors_of_its_own(folder: Path) -> None:
    red, _, blue = Recording(folder, Color.SPEED).scale.colors(np.array([0.5])).T
    assert red > blue


def test_scenes_schema_and_check_know_sand() -> None:
    listed = invoke("scenes").stdout
    for name in (
        "column-collapse-2d",
        "column-collapse",
        "hourglass-2d",
        "hourglass",
        "pouring-pile",
        "sand-on-mesh",
    ):
        assert f"{name} " in listed
    schema = json.loads(invoke("schema", "--simulator", "granular").stdout)
    assert {"material", "friction", "gauge", "sand"} <= schema["properties"].keys()
    checked = invoke("check", "hourglass-2d", "--set", "friction.model=box").stdout
    assert "box, on walls 0.4, 0.3, 0.3" in checked
    assert "stresses" in checked


def test_a_solid_without_effect_on_cells_is_reported() -> None:
    """Of whole cells it holds nothing; with cut cells it is a wall, and nothing is said."""
    plate, sand = box([0.2, 0.19], [0.8, 0.21]), [box([0.0, 0.3], [1.0, 0.5])]
    for solids, told in (("voxel", True), ("cut-cell", False)):
        simulation = create(
            scene(size=[1.0, 0.5], resolution=16, sand=sand, solid=[plate], solids=solids)
        )
        assert (
            any(
                "solid[0] (box) contains no center of a cell" in note for note in simulation.notes()
            )
            == told
        )


def test_the_frame_before_the_first_step_shows_the_start() -> None:
    simulation = create(scene(size=[1.0, 0.5], resolution=16, sand=[box([0.0, 0.0], [0.5, 0.25])]))
    points, cells = simulation.frame()
    assert len(points.points) == simulation.particles.count
    full = (cells.index[:, :2] < [8, 4]).all(axis=1)
    assert full.sum() == 8 * 4
    inner = (cells.index[:, :2] < [7, 3]).all(axis=1)
    # As the particles' kernels see it.
    np.testing.assert_allclose(cells.fields["fraction"][inner], 0.6, rtol=0.1)
    assert (cells.fields["fraction"][~full] < 0.3).all()  # the part that reaches over its edge
    assert not points.fields["pressure"].any()
