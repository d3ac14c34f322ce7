"""Runs that write surfaces, from a scene file to the folder."""

import meshio
import pytest

from mesh_checks import assert_closed, enclosed
from small_runs import run_scene_file
from warp_lcp.scene.scene_file import load_scene

SCENE = """
[scene]
simulator = "fluids"
[time]
duration = 0.1
frames_per_second = 20
[domain]
size = [0.5, 0.5, 0.25]
resolution = 12
[[liquid]]
shape = "box"
min = [0, 0, 0]
max = [0.25, 0.25, 0.25]
[output]
particles = false
grid = false
surface = true
"""


def test_a_run_writes_a_series_of_closed_surfaces(tmp_path):
    (tmp_path / "dam.toml").write_text(SCENE)
    out = tmp_path / "out"
    assert (
        run_scene_file(tmp_path / "dam.toml", out, "output.surface_ply=true").status == "finished"
    )
    names = [f"surface_{index:06d}.{suffix}" for index in range(3) for suffix in ("ply", "vtu")]
    assert sorted(file.name for file in (out / "frames").iterdir()) == names
    assert (out / "surface.pvd").read_text().count("DataSet") == 3
    assert not (out / "particles.pvd").exists()
    for index in range(3):
        vtu, ply = (
            meshio.read(out / f"frames/surface_{index:06d}.{suffix}") for suffix in ("vtu", "ply")
        )
        corners = vtu.cells_dict["triangle"]
        assert_closed(corners)
        assert enclosed(vtu.points, corners) == pytest.approx(0.25**3, rel=0.08)
        assert vtu.point_data["velocity"].shape == vtu.points.shape
        assert (ply.points == vtu.points).all()
        assert (ply.cells_dict["triangle"] == corners).all()


def test_an_interrupted_run_writes_the_same_surfaces(tmp_path):
    (tmp_path / "dam.toml").write_text(SCENE)
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    run_scene_file(tmp_path / "dam.toml", uninterrupted)
    run_scene_file(tmp_path / "dam.toml", parts, last_frame=1)
    run_scene_file(tmp_path / "dam.toml", parts, resume=True)
    for index in range(3):
        file = f"frames/surface_{index:06d}.vtu"
        assert (parts / file).read_bytes() == (uninterrupted / file).read_bytes()


def test_a_run_without_output_computes_no_frame(dots, scene_file, tmp_path, monkeypatch):
    frame_times = []
    kind = type(dots.create(load_scene(scene_file), device="cpu", folder=tmp_path))
    monkeypatch.setattr(kind, "frame", lambda self: frame_times.append(self.time) or [])
    run_scene_file(scene_file, tmp_path / "out", "output.particles=false", "output.grid=false")
    assert frame_times == []
    run_scene_file(scene_file, tmp_path / "more", "output.grid=false")
    assert len(frame_times) > 5
