"""FCLIB files in the format of its own writer.

The tests cover three kinds of matrices, local and global problems, solutions, and wrong input.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from warp_lcp.gallery.contact_scenes import box_stack
from warp_lcp.gallery.fclib import read_fclib
from warp_lcp.rigid.contact_models import BoxedModel

h5py = pytest.importorskip("h5py")
STORED = {"triplet": 0, "columns": -1, "rows": -2}


def write_matrix(group, name, matrix, kind="triplet"):
    g, m = group.create_group(name), scipy.sparse.coo_array(matrix)
    if kind == "triplet":
        nz, p, i, x = m.nnz, m.row, m.col, m.data
    else:
        c = m.tocsc() if kind == "columns" else m.tocsr()
        nz, p, i, x = STORED[kind], c.indptr, c.indices, c.data
    for key, value in (("nzmax", m.nnz), ("m", m.shape[0]), ("n", m.shape[1]), ("nz", nz)):
        g[key] = np.array([value], dtype=np.int32)
    g["p"], g["i"], g["x"] = p.astype(np.int32), i.astype(np.int32), x


def write_local(path, W, q, mu, kind="triplet", dim=3, joints=None, solution=None):
    with h5py.File(path, "w") as file:
        group = file.create_group("fclib_local")
        group["spacedim"] = np.array([dim], dtype=np.int32)
        write_matrix(group, "W", W, kind)
        group["vectors/q"], group["vectors/mu"] = q, mu
        group["info/title"] = np.bytes_("a title")
        if joints:
            V, R, s = joints
            write_matrix(group, "V", V, kind)
            write_matrix(group, "R", R, kind)
            group["vectors/s"] = s
        if solution is not None:
            file["solution/r"] = solution


@pytest.mark.parametrize("kind", STORED)
def test_local_problems_come_back(tmp_path, kind):
    system = box_stack(2).assemble(0.01).system
    method = wl.SubspaceMinimization(precision="double", backtracks=-1)
    expected = wl.solve(BoxedModel().problem(system).lcp(device="cpu"), method).x.numpy()
    write_local(
        tmp_path / "stack.hdf5", system.B, system.q, system.friction, kind, solution=expected
    )
    read = read_fclib(tmp_path / "stack.hdf5")
    assert read.title == read.system.name == "a title"
    np.testing.assert_allclose(read.system.B.toarray(), system.B.toarray(), atol=1e-15)
    np.testing.assert_array_equal(read.system.q, system.q)
    np.testing.assert_array_equal(read.system.friction, system.friction)
    np.testing.assert_array_equal(read.solution, expected)
    assert wl.solve(BoxedModel().problem(read.system).lcp(device="cpu"), method)


@pytest.mark.parametrize("kind", STORED)
def test_unsymmetric_blocks_are_read_the_right_way_round(tmp_path, kind):
    """Orientation of unsymmetric blocks.

    V is not square: swapped rows and columns show.
    """
    rng = np.random.default_rng(17)
    root = rng.standard_normal((8, 8))
    full = root @ root.T
    write_local(
        tmp_path / "v.hdf5",
        full[:6, :6],
        np.arange(6.0),
        np.array([0.1, 0.2]),
        kind,
        joints=(full[:6, 6:], full[6:, 6:], [7.0, 8.0]),
    )
    system = read_fclib(tmp_path / "v.hdf5").system
    np.testing.assert_allclose(system.B.toarray(), full, atol=1e-14)
    np.testing.assert_array_equal(system.q, [0, 1, 2, 3, 4, 5, 7, 8])
    assert np.isinf(system.lower).all() and len(system.lower) == 2


def test_a_global_problem_has_the_velocities_of_its_bodies(tmp_path):
    """Velocities of the bodies of a global problem.

    The equations M v = H r + G l + f, u = H'v + w, G'v + b = 0 are written out for random impulses.
    """
    rng = np.random.default_rng(29)
    root = rng.standard_normal((7, 7))
    M, H, G = root @ root.T + np.eye(7), rng.standard_normal((7, 4)), rng.standard_normal((7, 1))
    f, w, b = rng.standard_normal(7), rng.standard_normal(4), rng.standard_normal(1)
    with h5py.File(tmp_path / "g.hdf5", "w") as file:
        group = file.create_group("fclib_global")
        group["spacedim"] = np.array([2], dtype=np.int32)
        for name, value in (("M", M), ("H", H), ("G", G)):
            write_matrix(group, name, value)
        for name, value in (("f", f), ("w", w), ("b", b), ("mu", [0.3, 0.4])):
            group[f"vectors/{name}"] = value
    system = read_fclib(tmp_path / "g.hdf5").system
    assert (system.dim, system.contacts, len(system.lower)) == (2, 2, 1)
    x = rng.standard_normal(5)
    v = np.linalg.solve(M, H @ x[:4] + G @ x[4:] + f)
    np.testing.assert_allclose(
        system.B @ x + system.q, np.concatenate([H.T @ v + w, G.T @ v + b]), atol=1e-12
    )


def test_wrong_files_are_named(tmp_path):
    path = tmp_path / "wrong.hdf5"
    path.write_text("no HDF5")
    with pytest.raises(ValueError, match="cannot be read as HDF5"):
        read_fclib(path)
    with h5py.File(path, "w") as file:
        file["else"] = 1.0
    with pytest.raises(ValueError, match="neither fclib_local nor fclib_global"):
        read_fclib(path)
    unsymmetric = np.eye(3) + np.eye(3, k=1)
    cases = [
        (unsymmetric, [0.1], "not symmetric"),
        (np.eye(3), [0.1, 0.2], "mu has 2 values"),
        (np.eye(3), [-0.1], "friction holds"),
    ]
    for W, mu, message in cases:
        write_local(path, W, np.zeros(3), np.array(mu))
        with pytest.raises(ValueError, match=f"{path}: .*{message}"):
            read_fclib(path)
    write_local(path, np.eye(3), np.zeros(3), np.array([0.1]))
    with h5py.File(path, "a") as file:
        file["fclib_local/W/nz"][0] = -7
    with pytest.raises(ValueError, match="is not a sparse matrix"):
        read_fclib(path)
    with h5py.File(path, "a") as file:
        del file["fclib_local/W"]
    with pytest.raises(ValueError, match="has no matrix W"):
        read_fclib(path)
    write_local(path, np.eye(3), np.zeros(3), np.array([0.1]), solution=np.zeros(2))
    with pytest.raises(ValueError, match="the solution has 2 values"):
        read_fclib(path)


def hostile(file, name):
    """Change a file to malicious content.

    A size that no stored data can have, indices beyond a matrix, and entries of other files.
    """
    matrix = file["fclib_local/W"]
    if name == "size":
        matrix["m"][0] = matrix["n"][0] = 2**31 - 1
    elif name == "column":
        matrix["i"][1] = 10**6
    elif name == "never written":
        del matrix["x"]
        matrix.create_dataset("x", shape=(10**12,), dtype=np.float64)
    elif name == "packed":
        del matrix["x"]
        matrix.create_dataset(
            "x", shape=(10**12,), dtype=np.float64, chunks=(10**6,), compression="gzip"
        )
    elif name == "link":
        del matrix["x"]
        matrix["x"] = h5py.ExternalLink("other.hdf5", "/x")
    elif name == "group":
        del matrix["x"]
        matrix.create_group("x")
    elif name == "text":
        del matrix["x"]
        matrix["x"] = np.bytes_("1.0")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("size", "W has shape 2147483647 x 2147483647: expected, from the vectors, 3 x 3"),
        ("column", "is not a sparse matrix"),
        ("never written", "these take 8e[+]03 GB, and the file has 0 bytes"),
        ("packed", "and the file has 0 bytes"),
        ("link", "W/x is in another file"),
        ("group", "x is not a dataset of this file"),
        ("text", r"x is \|S3: must be finite numbers"),
    ],
)
def test_files_that_could_harm_are_refused(tmp_path, name, message):
    path = tmp_path / "hostile.hdf5"
    write_local(path, np.eye(3), np.zeros(3), np.array([0.1]), "rows")
    write_local(tmp_path / "other.hdf5", np.eye(3), np.zeros(3), np.array([0.1]))
    with h5py.File(path, "a") as file:
        hostile(file, name)
    assert path.stat().st_size < 30_000
    with pytest.raises(ValueError, match=message):
        read_fclib(path)


def test_each_contact_has_friction(tmp_path):
    """Friction of each contact; rows without friction became joints before."""
    write_local(tmp_path / "few.hdf5", np.eye(6), np.ones(6), np.array([0.3]))
    with pytest.raises(ValueError, match="mu has 1 values for 6 rows of 3 a contact"):
        read_fclib(tmp_path / "few.hdf5")


def test_entries_that_overflow(tmp_path):
    write_local(tmp_path / "large.hdf5", np.full((3, 3), 1.5e308), np.ones(3), np.array([0.3]))
    assert np.isfinite(read_fclib(tmp_path / "large.hdf5").system.B.data).all()


def test_vectors_never_written_are_zero(tmp_path):
    path = tmp_path / "unwritten.hdf5"
    write_local(path, np.eye(3), np.ones(3), np.array([0.3]))
    with h5py.File(path, "r+") as file:
        vectors = file["fclib_local/vectors"]
        del vectors["q"]
        vectors.create_dataset("q", (3,), dtype="f8")
    np.testing.assert_array_equal(read_fclib(path).system.q, 0.0)
