"""Frictional contact problems of the FCLIB collection, HDF5 files (needs h5py).

It needs the extra `contact`. The layout is that of FCLIB's own writer
(github.com/FrictionalContactLibrary/fclib, src/fclib.h and src/fclib.c):

- /fclib_local has spacedim, matrices W and, together, V and R, and vectors/{q, mu, s}:
  u = W r + V l + q, V'r + R l + s = 0.
- /fclib_global has spacedim, M, H and possibly G, and vectors/{f, w, mu, b}:
  M v = H r + G l + f, u = H'v + w, G'v + b = 0.
- A matrix is a group of m, n, nz, nzmax, p, i, x: triplets (rows p, columns i) if nz >= 0,
  compressed columns if nz = -1, compressed rows if nz = -2.
- Rows of a contact are normal, then tangents. /solution/{r, l} can have a solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from warp_lcp.files.archive import DEFLATED
from warp_lcp.files.size_limits import SizeLimitError, check_claim
from warp_lcp.rigid.contact_models import ContactSystem

if TYPE_CHECKING:
    import h5py

UNWRITTEN = 2**24  # most bytes of a dataset that was never written, which is read as zeros


@dataclass(frozen=True, eq=False)
class FclibProblem:
    """Content of an FCLib file.

    Args:
        system: velocities at contacts for impulses; the equations of l are its joint rows.
        solution: impulses (r, l) in the file [N s], a vector like `system.q`; None without a
            solution.
        title: title of the problem; empty without one.
    """

    system: ContactSystem
    solution: np.ndarray | None
    title: str


def read_fclib(path: Path | str) -> FclibProblem:
    """Read a local or a global problem from an FCLib file.

    A global problem is reduced to its contacts by the factors of M.

    Raises:
        ImportError: h5py is missing.
        ValueError: the file is not an FCLIB problem; the message names what is missing or wrong.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError("FCLIB files need h5py: pip install 'warp-lcp[contact]'") from error
    path = Path(path)
    try:
        with h5py.File(path, "r") as file:
            return _read(file, path)
    except SizeLimitError as error:
        raise ValueError(f"{path}: {error}") from error
    except (OSError, RuntimeError, KeyError, TypeError, OverflowError, MemoryError) as error:
        raise ValueError(
            f"{path}: cannot be read as HDF5: {error or type(error).__name__}"
        ) from error


def _read(file: h5py.File, path: Path) -> FclibProblem:
    """Return the problem of an open file."""
    kind = next((name for name in ("fclib_local", "fclib_global") if name in file), None)
    if kind is None:
        raise ValueError(f"{path}: holds neither fclib_local nor fclib_global")
    group = _inside(file, kind, path)
    dim = _number(group, "spacedim", path)
    if dim not in (2, 3):
        raise ValueError(f"{path}: spacedim = {dim}: must be 2 or 3")
    with np.errstate(over="ignore", invalid="ignore"):
        B, q, joints = (_local if kind == "fclib_local" else _global)(group, path)
    if not (np.isfinite(B.data).all() and np.isfinite(q).all()):
        raise ValueError(
            f"{path}: products of the matrices and vectors overflow: their entries are too large"
        )
    mu, rows = _values(group, "vectors/mu", path), len(q) - joints
    if dim * len(mu) != rows:
        raise ValueError(f"{path}: mu has {len(mu)} values for {rows} rows of {dim} a contact")
    title = _text(group, "info/title", path)
    free = np.full(joints, np.inf)
    try:
        system = ContactSystem(title or path.stem, B, q, mu, -free, free, dim)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return FclibProblem(system, _solution(file, len(q), joints, path), title)


def _local(group: h5py.Group, path: Path) -> tuple[scipy.sparse.csr_array, np.ndarray, int]:
    """Return B = [W, V; V', R], (q, s) and the number of joint rows."""
    q = _values(group, "vectors/q", path)
    W = _matrix(group, "W", (len(q), len(q)), path)
    if "V" not in group:
        return _symmetric(W, path), q, 0
    s = _values(group, "vectors/s", path)
    V, R = _matrix(group, "V", (len(q), len(s)), path), _matrix(group, "R", (len(s), len(s)), path)
    return (
        _symmetric(scipy.sparse.block_array([[W, V], [V.T, R]]), path),
        np.concatenate([q, s]),
        len(s),
    )


def _global(group: h5py.Group, path: Path) -> tuple[scipy.sparse.csr_array, np.ndarray, int]:
    """Return B = C'M^-1 C, C'M^-1 f + (w, b) and the number of joint rows.

    C = (H, G).
    """
    joints = 0
    f, q = _values(group, "vectors/f", path), _values(group, "vectors/w", path)
    M, C = _matrix(group, "M", (len(f), len(f)), path), _matrix(group, "H", (len(f), len(q)), path)
    if "G" in group:
        b = _values(group, "vectors/b", path)
        C = scipy.sparse.csr_array(
            scipy.sparse.hstack([C, _matrix(group, "G", (len(f), len(b)), path)])
        )
        q, joints = np.concatenate([q, b]), len(b)
    check_claim(
        f"M^-1 C of {len(f)} x {len(q)} values", 2 * np.dtype(np.float64).itemsize * len(f) * len(q)
    )
    try:
        solve = scipy.sparse.linalg.splu(scipy.sparse.csc_array(M)).solve
    except RuntimeError as error:
        raise ValueError(f"{path}: M has no inverse: {error}") from error
    response = scipy.sparse.csr_array(np.asarray(solve(C.toarray())))
    return _symmetric(C.T @ response, path), C.T @ np.asarray(solve(f)) + q, joints


def _matrix(
    group: h5py.Group, name: str, shape: tuple[int, int], path: Path
) -> scipy.sparse.csr_array:
    """Return a matrix of a given shape, in one of FCLIB's three formats."""
    if name not in group:
        raise ValueError(f"{path}: {group.name} has no matrix {name}")
    m, n, nz = (_number(group, f"{name}/{key}", path) for key in ("m", "n", "nz"))
    if (m, n) != shape:
        raise ValueError(
            f"{path}: {group.name}/{name} has shape {m} x {n}: expected, from the vectors, "
            f"{shape[0]} x {shape[1]}"
        )
    p, i = (_values(group, f"{name}/{key}", path, "iu").astype(np.int64) for key in ("p", "i"))
    x = _values(group, f"{name}/x", path)
    try:
        if nz >= 0:
            return scipy.sparse.coo_array((x[:nz], (p[:nz], i[:nz])), shape=(m, n)).tocsr()
        used = int(p[-1])
        made = {-1: scipy.sparse.csc_array, -2: scipy.sparse.csr_array}.get(nz)
        if made is None:
            raise ValueError(f"nz = {nz}: must be >= 0, -1 or -2")
        stored = made((x[:used], i[:used], p), shape=(m, n))
        stored.check_format(full_check=True)  # an index beyond the shape would write out of bounds
        return scipy.sparse.csr_array(stored)
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path}: {group.name}/{name} is not a sparse matrix: {error}") from error


def _symmetric(B: scipy.sparse.sparray, path: Path) -> scipy.sparse.csr_array:
    """Return B without the asymmetry due to rounding."""
    B = scipy.sparse.csr_array(B)
    if 0 in B.shape or not np.isfinite(B.data).all():
        raise ValueError(f"{path}: the matrix of the contacts is empty or not finite")
    if abs(B - B.T).max() > 1e-6 * abs(B).max():
        raise ValueError(f"{path}: the matrix of the contacts is not symmetric")
    return scipy.sparse.csr_array(0.5 * B + 0.5 * B.T)


def _values(group: h5py.Group, name: str, path: Path, kinds: str = "iuf") -> np.ndarray:
    """Return a dataset of numbers of given kinds as a vector."""
    found = np.asarray(_dataset(group, name, path)[()])
    if found.dtype.kind not in kinds or not np.isfinite(found).all():
        raise ValueError(f"{path}: {group.name}/{name} is {found.dtype}: must be finite numbers")
    return np.atleast_1d(found).ravel()


def _number(group: h5py.Group, name: str, path: Path) -> int:
    """Return a dataset of one integer."""
    values = _values(group, name, path, "iu")
    if len(values) != 1:
        raise ValueError(f"{path}: {group.name}/{name} has {len(values)} values: expected one")
    return int(values[0])


def _dataset(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    """Return a dataset of this file, with a size that its stored bytes allow."""
    import h5py

    member = group
    for part in name.split("/"):
        member = _inside(member, part, path)
    if not isinstance(member, h5py.Dataset) or member.is_virtual or member.external:
        raise ValueError(f"{path}: {group.name}/{name} is not a dataset of this file")
    size, stored = int(member.nbytes), int(member.id.get_storage_size())
    # The fill value is 0: FCLIB creates datasets without writing to them.
    if stored == 0 and size <= UNWRITTEN and not member.chunks:
        return member
    check_claim(
        f"{name} of {size} bytes",
        size,
        stored=-(-size // DEFLATED) if member.chunks else size,
        available=stored,
    )
    return member


def _inside(group: h5py.Group, name: str, path: Path) -> h5py.Group | h5py.Dataset:
    """Return the member of a group, if it is in the same file."""
    import h5py

    if not isinstance(group, h5py.Group) or name not in group:
        raise ValueError(f"{path}: {group.name} has no {name}")
    if isinstance(group.get(name, getlink=True), h5py.ExternalLink):
        raise ValueError(f"{path}: {group.name}/{name} is in another file")
    return group[name]


def _text(group: h5py.Group, name: str, path: Path) -> str:
    """Return an optional string of a file."""
    if name not in group:
        return ""
    value = _dataset(group, name, path)[()]
    return value.decode(errors="replace").rstrip("\0") if isinstance(value, bytes) else str(value)


def _solution(file: h5py.File, rows: int, joints: int, path: Path) -> np.ndarray | None:
    """Return the impulses (r, l) of /solution, if there are any."""
    if "solution/r" not in file:
        return None
    r = _values(file, "solution/r", path)
    r = (
        np.concatenate([r, _values(file, "solution/l", path)])
        if joints and "solution/l" in file
        else r
    )
    if len(r) != rows:
        raise ValueError(f"{path}: the solution has {len(r)} values: expected {rows}")
    return r
