"""Cells as images, read back by VTK."""

import numpy as np
import pytest

from warp_lcp.frames.frame_folder import FrameFolder, frame_bytes
from warp_lcp.frames.vti import read_vti, write_vti
from warp_lcp.simulation import Cells

RNG = np.random.default_rng(2269)


def some_cells(dimension: int, counts=None) -> Cells:
    index = np.array([[3, 2, 1], [4, 2, 1], [4, 3, 1], [9, 7, 2]]) * [1, 1, dimension == 3]
    fields = {
        "pressure": np.array([1.5, 2.5, -3.5, 4.5]),
        "wall": np.array([True, False, True, False]),
        "velocity": np.arange(12, dtype=np.float32).reshape(4, 3),
    }
    return Cells("grid", index, 0.25, dimension, fields, counts)


def drawn(image):
    """Return the cells that ParaView draws, those that this filter passes."""
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    shell = vtkGeometryFilter()
    shell.SetInputData(image)
    shell.Update()
    return shell.GetOutput()


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("whole", [False, True])
def test_vtk_shows_exactly_the_cells(pyvista, tmp_path, dimension, whole):
    counts = (10, 8, 5 if dimension == 3 else 1) if whole else None
    cells = some_cells(dimension, counts)
    write_vti(tmp_path / "a.vti", cells)
    image = pyvista.read(tmp_path / "a.vti")
    assert isinstance(image, pyvista.ImageData)
    assert image.extent[::2] == ((0, 0, 0) if whole else tuple(cells.index.min(axis=0)))
    visible = [number for number in range(image.n_cells) if image.IsCellVisible(number)]
    assert len(visible) == 4
    middle = np.array([0.5, 0.5, 0.5 if dimension == 3 else 0.0])
    for index, pressure, wall, velocity in zip(cells.index, *cells.fields.values(), strict=True):
        number = image.find_containing_cell((index + middle) * 0.25)
        assert number in visible
        np.testing.assert_allclose(image.cell_data["pressure"][number], pressure)
        np.testing.assert_array_equal(image.cell_data["wall"][number], wall)
        np.testing.assert_array_equal(image.cell_data["velocity"][number], velocity)
    shell = pyvista.wrap(drawn(image))
    if dimension == 2:
        np.testing.assert_allclose(shell.area, 4 * 0.25**2)
    else:
        assert shell.n_cells == 4 * 6 - 2 * 2  # without the two that cells share


def test_every_frame_has_the_whole_grid(pyvista, tmp_path):
    few, none = (
        some_cells(3, (10, 8, 5)),
        Cells("grid", np.empty((0, 3), int), 0.25, 3, {"pressure": np.empty(0)}, (10, 8, 5)),
    )
    for cells in (few, none):
        write_vti(tmp_path / "a.vti", cells)
        image = pyvista.read(tmp_path / "a.vti")
        assert image.extent == (0, 10, 0, 8, 0, 5)
        assert sum(image.IsCellVisible(number) for number in range(image.n_cells)) == len(
            cells.index
        )


@pytest.mark.parametrize("dimension", [2, 3])
def test_an_image_of_nothing(pyvista, tmp_path, dimension):
    write_vti(tmp_path / "a.vti", Cells("grid", np.empty((0, 3), int), 0.25, dimension))
    image = pyvista.read(tmp_path / "a.vti")
    assert [image.IsCellVisible(number) for number in range(image.n_cells)] == [0]
    assert len(read_vti(tmp_path / "a.vti").index) == 0


@pytest.mark.parametrize("dimension", [2, 3])
def test_read_back(tmp_path, dimension):
    cells = some_cells(dimension)
    write_vti(tmp_path / "grid_000007.vti", cells)
    back = read_vti(tmp_path / "grid_000007.vti")
    assert (back.name, back.spacing, back.dimension) == ("grid", 0.25, dimension)
    order = np.lexsort(cells.index.T)  # x fastest
    np.testing.assert_array_equal(back.index, cells.index[order])
    assert back.fields.keys() == cells.fields.keys()
    for name, values in cells.fields.items():
        np.testing.assert_array_equal(back.fields[name], values[order])


def test_a_file_cut_short_is_refused(tmp_path):
    write_vti(tmp_path / "a.vti", some_cells(3))
    whole = (tmp_path / "a.vti").read_bytes()
    for size in (100, len(whole) // 2):
        (tmp_path / "a.vti").write_bytes(whole[:size])
        with pytest.raises(ValueError):
            read_vti(tmp_path / "a.vti")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'WholeExtent="', b'WholeExtent="0 1000000 0 1000000 0 1" was="'),
        (b'WholeExtent="', b'WholeExtent="0 1 0 1" was="'),
        (b'Spacing="', b'Spacing="nan nan nan" was="'),
        (b'offset="0"', b'offset="-9"'),
        (b'offset="0"', b'offset="999999999999"'),
        (b'type="Float64"', b'type="Float512"'),
        (b"vtkGhostType", b"no ghosts at all"),
        (b"UInt64", b"UInt32"),
        (b"<ImageData", b"<!-- --><ImageData"),
    ],
)
def test_files_with_impossible_sizes_are_refused(tmp_path, old, new):
    write_vti(tmp_path / "a.vti", some_cells(3))
    whole = (tmp_path / "a.vti").read_bytes()
    assert old in whole
    (tmp_path / "a.vti").write_bytes(whole.replace(old, new, 1))
    with pytest.raises(ValueError, match=r"a\.vti: is not a readable frame: "):
        read_vti(tmp_path / "a.vti")


def test_arrays_do_not_share_their_bytes(tmp_path):
    """Separate bytes of arrays.

    A name costs a file some bytes, and its reader a whole array.
    """
    write_vti(tmp_path / "a.vti", some_cells(3))
    array = b'<DataArray type="Float64" Name="%d" format="appended" offset="0"/>'
    whole = (tmp_path / "a.vti").read_bytes()
    (tmp_path / "a.vti").write_bytes(
        whole.replace(b"</CellData>", b"".join(array % n for n in range(9)) + b"</CellData>")
    )
    with pytest.raises(ValueError, match="its arrays do not match its"):
        read_vti(tmp_path / "a.vti")


def test_cells_outside_the_grid_are_refused(tmp_path):
    with pytest.raises(
        ValueError, match="the grid of 9 x 8 x 5 cells does not hold all cells of 'grid'"
    ):
        write_vti(tmp_path / "a.vti", some_cells(3, (9, 8, 5)))
    with pytest.raises(ValueError, match="'pressure' has 3 entries for 4"):
        write_vti(
            tmp_path / "a.vti",
            Cells("grid", some_cells(3).index, 0.25, 3, {"pressure": np.zeros(3)}),
        )
    assert list(tmp_path.iterdir()) == []


def test_estimate_is_near_the_file(tmp_path):
    cells = some_cells(3, (20, 20, 20))
    write_vti(tmp_path / "a.vti", cells)
    size = (tmp_path / "a.vti").stat().st_size
    assert size <= frame_bytes([cells], "vti") < 1.1 * size


def test_a_collection_of_images(pyvista, tmp_path):
    folder = FrameFolder(tmp_path, "vti")
    for index in range(3):
        folder.write(index, index / 7, [some_cells(3, (10, 8, 5))])
    reader = pyvista.get_reader(tmp_path / "grid.pvd")
    assert reader.time_values == [0.0, 1 / 7, 2 / 7]
    reader.set_active_time_point(2)
    block = reader.read()[0]
    assert isinstance(block, pyvista.ImageData)
    assert sum(block.IsCellVisible(number) for number in range(block.n_cells)) == 4


def test_a_run_that_goes_on_with_another_format_keeps_its_frames(tmp_path):
    first = FrameFolder(tmp_path)
    for index in range(3):
        first.write(index, float(index), [some_cells(3)])
    second = FrameFolder(tmp_path, "vti")
    second.resume([0.0, 1.0])
    second.write(2, 2.0, [some_cells(3)])
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == [
        "grid_000000.vtu",
        "grid_000001.vtu",
        "grid_000002.vti",
    ]
    assert [
        line.split('"')[-2]
        for line in (tmp_path / "grid.pvd").read_text().splitlines()
        if "DataSet" in line
    ] == [f"frames/grid_{index:06d}.{kind}" for index, kind in enumerate(["vtu", "vtu", "vti"])]
