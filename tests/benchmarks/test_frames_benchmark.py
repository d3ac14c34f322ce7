"""The benchmark of frames, on a small grid."""

import numpy as np
import pytest

from warp_lcp.benchmarks.frames import format_table, share_table, waves, write_vtkhdf


def test_every_format_is_measured(tmp_path):
    pytest.importorskip("h5py", reason="VTKHDF files need it")
    rows = [line.split(" | ") for line in format_table([16], 1, tmp_path)[2:]]
    assert [row[1] for row in rows] == ["vtu", "vti", "vtkhdf", "nvdb, level set", "nvdb, density"]
    assert all(float(cell.rstrip(" |")) >= 0.0 for row in rows for cell in row[2:])


def test_vtk_opens_the_format_that_was_not_chosen(tmp_path):
    pytest.importorskip("h5py", reason="VTKHDF files need it")
    pyvista = pytest.importorskip("pyvista", reason="VTK reads the files back")
    cells, mask = waves(8)
    write_vtkhdf(tmp_path / "a.vtkhdf", cells, mask)
    image = pyvista.read(tmp_path / "a.vtkhdf")
    assert sum(map(image.IsCellVisible, range(image.n_cells))) == len(cells.index)
    np.testing.assert_array_equal(np.sort(image.cell_data["pressure"][mask.ravel()]), np.sort(cells.fields["pressure"]))


def test_the_share_of_a_run(tmp_path):
    lines = share_table("dam-break-2d", ["time.duration=0.05", "domain.resolution=16"], 1, "cpu", tmp_path)
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| with", "| without", "| share"]
