"""Frames of runs in each format.

Cells as VTU and VTI are equal, and volumes lie where the particles are.
"""

from pathlib import Path

import meshio
import numpy as np
import pytest
from typer.testing import CliRunner

import small_liquids
import small_sands
from warp_lcp.cli.commands import app
from warp_lcp.frames.nvdb import LEAF, LEAF_NODE
from warp_lcp.render.image_content import Color
from warp_lcp.render.recording import Recording
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.table import SceneError

SMALL = ("domain.resolution=24", "domain.size=[1.2, 0.6, 0.6]", "time.duration=0.1")


def run(out: Path, scene: str, *overrides: str) -> Path:
    sets = [word for override in overrides for word in ("--set", override)]
    result = CliRunner().invoke(app, ["run", scene, "--out", str(out), *sets])
    assert result.exit_code == 0, result.stderr
    return out


def columns(folder: Path) -> list[list[str]]:
    """Return the log without its last column, the seconds."""
    return [line.split(",")[:-1] for line in (folder / "log.csv").read_text().splitlines()]


def dense(path: Path, outside: float, shape: tuple[int, int, int]) -> np.ndarray:
    """Return the voxels of a file's leaves, x first.

    They are found by their size alone: they end the file.
    """
    data, tree = path.read_bytes(), 16 + 176 + len(path.stem.rpartition("_")[0]) + 1 + 672
    leaves = np.frombuffer(
        data[-int(np.frombuffer(data, "<u4", 1, tree + 32)[0]) * LEAF_NODE.itemsize :], LEAF_NODE
    )
    values = np.full([-(-count // LEAF) * LEAF for count in shape], outside, dtype=np.float32)
    for leaf in leaves:
        x, y, z = leaf["low"]
        values[x : x + LEAF, y : y + LEAF, z : z + LEAF] = leaf["values"].reshape(LEAF, LEAF, LEAF)
    return values[tuple(slice(count) for count in shape)]


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("scene", ["dam-break", "column-collapse"])
def test_volumes_lie_where_the_particles_are(tmp_path, scene):
    sizes = SMALL if scene == "dam-break" else ("domain.resolution=24", "time.duration=0.05")
    model = load_scene(scene, sizes)
    plain, out = (
        run(tmp_path / "plain", scene, *sizes),
        run(tmp_path / "volume", scene, *sizes, "output.volume=true"),
    )
    for index in (0, model.time.frame_count):
        particles = meshio.read(out / "frames" / f"particles_{index:06d}.vtu").points
        density = dense(out / "frames" / f"density_{index:06d}.nvdb", 0.0, model.cell_counts)
        distance = dense(out / "frames" / f"level_set_{index:06d}.nvdb", 9.0, model.cell_counts)
        at_rest = model.particles.per_axis**3
        # A part of kernels at walls lies outside.
        np.testing.assert_allclose(density.sum() * at_rest, len(particles), rtol=0.12)
        cells = tuple(np.floor(particles / model.spacing).astype(int).T)
        assert (density[cells] > 0.1).all()
        assert np.median(distance[cells]) < 0.0
        assert (distance[cells] < model.spacing).all()
        inside = np.argwhere(distance < 0.0) + 0.5
        np.testing.assert_allclose(
            inside.mean(axis=0) * model.spacing, particles.mean(axis=0), atol=0.3 * model.spacing
        )
        filled = np.zeros(model.cell_counts, dtype=bool)
        filled[cells] = True
        assert (distance[~filled] > -0.5 * model.spacing).all()

    assert columns(plain) == columns(out)  # the volume does not change the run
    assert not list(plain.glob("frames/*.nvdb"))


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("scene", ["dam-break", "column-collapse"])
def test_openvdb_volumes_have_the_velocity_of_the_particles(tmp_path, scene):
    tinyvdb = pytest.importorskip("tinyvdb", reason="an independent reader of OpenVDB files")
    sizes = SMALL if scene == "dam-break" else ("domain.resolution=24", "time.duration=0.05")
    both = (*sizes, "output.volume=true")
    out, plain = run(tmp_path / "vdb", scene, *both, "output.volume_format=vdb"), tmp_path / "nvdb"
    run(plain, scene, *both)
    assert columns(plain) == columns(out)  # the velocity does not change the run
    model = load_scene(scene, sizes)
    last = model.time.frame_count
    assert len(list(out.glob("frames/volume_*.vdb"))) == last + 1
    assert not list(out.glob("frames/*.nvdb"))
    for index in (0, last):
        with tinyvdb.open(str(out / "frames" / f"volume_{index:06d}.vdb")) as file:
            file.read_grids()
            for number, name in enumerate(("level_set", "density")):
                of_same_run = plain / "frames" / f"{name}_{index:06d}.nvdb"
                expected = dense(of_same_run, 0.0, model.cell_counts)
                sparse = file.grid(number).to_sparse()
                x, y, z = np.frombuffer(sparse["coords"], dtype=np.int32).reshape(-1, 3).T
                values = np.frombuffer(sparse["values"], dtype=np.float32)
                # TinyVDB halves numbers of 16 bits below 2^-14.
                np.testing.assert_allclose(values, expected[x, y, z], rtol=1e-3, atol=2.0**-15)
    simulators = {"dam-break": small_liquids, "column-collapse": small_sands}
    model = load_scene(scene, (*both, "output.volume_format=vdb"))
    simulation = simulators[scene].create(model)
    for _ in range(3):
        simulation.step(simulation.stable_dt())
    points = simulation.points()
    (group,) = simulation.volumes()
    assert [volume.name for volume in group.volumes] == ["level_set", "density", "velocity"]
    x, y, z = np.floor(points.points / model.spacing).astype(int).T
    velocity, of_points = group.volumes[2].values[z, y, x], points.fields["velocity"]
    assert np.square(velocity - of_points).mean() < 0.06 * np.square(of_points).mean()
    distance, moves = group.volumes[0].values, group.volumes[2].values.any(axis=3)
    assert not moves[distance >= group.volumes[0].band].any()
    assert moves[distance < 0.0].all()


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("scene", ["dam-break", "dam-break-2d"])
def test_images_show_what_hexahedra_do(tmp_path, scene):
    sizes = SMALL if scene == "dam-break" else ("domain.resolution=32", "time.duration=0.1")
    hexahedra, images = (
        run(tmp_path / kind, scene, *sizes, f"output.grid_format={kind}") for kind in ("vtu", "vti")
    )
    last = load_scene(scene, sizes).time.frame_count
    assert len(list(images.glob("frames/grid_*.vti"))) == last + 1
    assert not list(images.glob("frames/grid_*.vtu"))
    for index in (0, last):
        expected, found = (
            Recording(folder, Color.PRESSURE).read(index) for folder in (hexahedra, images)
        )
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1])
    assert np.abs(expected[1]).max() > 100.0  # [Pa]
    pyvista = pytest.importorskip("pyvista", reason="VTK reads the files back")
    image = pyvista.read(images / "frames" / f"grid_{last:06d}.vti")
    grid = pyvista.read(hexahedra / "frames" / f"grid_{last:06d}.vtu")
    counts = [
        count if axis < 2 or scene == "dam-break" else 0
        for axis, count in enumerate(load_scene(scene, sizes).cell_counts)
    ]
    assert list(image.extent[1::2]) == counts
    numbers = [image.find_containing_cell(center) for center in grid.cell_centers().points]
    for name in grid.cell_data:
        np.testing.assert_array_equal(image.cell_data[name][numbers], grid.cell_data[name])
    assert sum(map(image.IsCellVisible, range(image.n_cells))) == grid.n_cells


def test_a_volume_of_a_flat_scene_is_refused():
    with pytest.raises(SceneError, match=r"output.volume = true: needs a 3-D domain"):
        load_scene("dam-break-2d", ["output.volume=true"])
