"""Closed triangle surfaces: read or generated, checked and repaired."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import warp as wp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from warp_lcp.grid.mesh_crossings import SelfIntersections, find_self_crossings
from warp_lcp.grid.mesh_file import read_triangles
from warp_lcp.grid.signed_distance_kernels import mesh_thickness

Triangles = tuple[np.ndarray, np.ndarray]  # vertices, and triangles of them


def tube(
    curve: np.ndarray, normals: np.ndarray, binormals: np.ndarray, radius: float, sides: int
) -> Triangles:
    """Return the closed tube around a closed curve, oriented outward.

    Args:
        curve: points along the curve, shape (n, 3); the last is joined to the first.
        normals: unit vectors across the curve, shape (n, 3).
        binormals: tangent x normal, shape (n, 3).
        radius: radius of the tube, less than the curve's radius of curvature and half the distance
            of its strands.
        sides: number of vertices around the tube.

    Returns:
        Vertices of shape (n * sides, 3) and triangles of shape (2 * n * sides, 3).
    """
    angle = 2.0 * np.pi * np.arange(sides) / sides
    across = np.cos(angle)[:, None] * normals[:, None] + np.sin(angle)[:, None] * binormals[:, None]
    vertices = (curve[:, None] + radius * across).reshape(-1, 3)
    along, around = np.meshgrid(np.arange(len(curve)), np.arange(sides), indexing="ij")
    a = along * sides + around
    b = (along + 1) % len(curve) * sides + around
    c = (along + 1) % len(curve) * sides + (around + 1) % sides
    d = along * sides + (around + 1) % sides
    triangles = np.concatenate(
        [np.stack([a, c, b], axis=-1).reshape(-1, 3), np.stack([a, d, c], axis=-1).reshape(-1, 3)]
    )
    return vertices, triangles


def torus() -> Triangles:
    """Return a torus about the z axis: radius 0.35, tube radius 0.15.

    It fills [-0.5, 0.5] x [-0.5, 0.5] x [-0.15, 0.15].
    """
    t = 2.0 * np.pi * np.arange(96) / 96
    zero = np.zeros_like(t)
    normals = np.stack([np.cos(t), np.sin(t), zero], axis=-1)
    tangents = np.stack([-np.sin(t), np.cos(t), zero], axis=-1)
    return tube(0.35 * normals, normals, np.cross(tangents, normals), 0.15, 48)


def knot() -> Triangles:
    """Return a trefoil knot of round tube with a largest extent of 1.

    The curve is (sin t + 2 sin 2t, cos t - 2 cos 2t, -sin 3t), scaled.
    """
    t = 2.0 * np.pi * np.arange(240) / 240
    curve = np.stack(
        [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=-1
    )
    first = np.stack(
        [np.cos(t) + 4 * np.cos(2 * t), -np.sin(t) + 4 * np.sin(2 * t), -3 * np.cos(3 * t)], axis=-1
    )
    second = np.stack(
        [-np.sin(t) - 8 * np.sin(2 * t), -np.cos(t) + 8 * np.cos(2 * t), 9 * np.sin(3 * t)], axis=-1
    )
    # Never zero on this curve, so Frenet's frame closes without a seam.
    binormals = np.cross(first, second)
    binormals /= np.linalg.norm(binormals, axis=1, keepdims=True)
    tangents = first / np.linalg.norm(first, axis=1, keepdims=True)
    normals = np.cross(binormals, tangents)
    vertices, triangles = tube(curve, normals, binormals, KNOT_TUBE, 24)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return (vertices - 0.5 * (low + high)) / (high - low).max(), triangles


KNOT_TUBE = 0.5
BUILTIN: dict[str, Callable[[], Triangles]] = {"torus": torus, "knot": knot}


BUILTIN_PREFIX = "builtin:"
# Fraction of the mesh's diagonal: coarser than float32 coordinates, far finer than a cell.
WELD = 1e-6
FLAT = 1e-12  # twice the area over the longest edge squared, below which a triangle has no area
NO_VOLUME = 1e-9  # least volume, as a fraction of the mesh's diagonal cubed
LARGEST = 1e18  # largest coordinate, as for numbers of a scene
# Vertices to merge with each, at most on average. With more, the mesh has shrunk to a point beside
# a stray vertex.
CLOSE_VERTICES = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedSurface:
    """Closed, consistently oriented triangle surface.

    Every edge is used as often in one direction as in the other; normals point outward.

    Build one with `read_mesh`, `builtin_mesh` or `close_surface`, which check that.

    Args:
        name: name of the mesh in messages.
        vertices: in the mesh's own units, float64 of shape (n, 3).
        triangles: vertex indices, int32 of shape (m, 3), counterclockwise seen from outside.
        warnings: repairs, a line each.
    """

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    warnings: tuple[str, ...] = ()
    _meshes: dict[str, wp.Mesh] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def volume(self) -> float:
        """Volume inside, in the mesh's units cubed."""
        return float(_cone_volumes(self.vertices - self.center, self.triangles).sum())

    @cached_property
    def center(self) -> np.ndarray:
        """Center of the mesh's bounding box, shape (3,)."""
        return 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))

    @cached_property
    def size(self) -> float:
        """Half the diagonal of the mesh's bounding box."""
        return 0.5 * _diagonal(self.vertices)

    def on_device(self, device: wp.Device) -> wp.Mesh:
        """Return the mesh for Warp queries, built once per device.

        In coordinates (vertex - center) / size.
        """
        mesh = self._meshes.get(str(device))
        if mesh is None:
            points = wp.array(
                (self.vertices - self.center) / self.size, dtype=wp.vec3, device=device
            )
            indices = wp.array(self.triangles.ravel(), dtype=wp.int32, device=device)
            mesh = wp.Mesh(points, indices, support_winding_number=True)
            self._meshes[str(device)] = mesh
        return mesh

    @cached_property
    def crossings(self) -> SelfIntersections:
        """Self-intersections of the surface and parts inside itself; found on the CPU."""
        mesh = self.on_device(wp.get_device("cpu"))
        found = find_self_crossings(mesh, (self.vertices - self.center) / self.size, self.triangles)
        return (
            found
            if found.place is None
            else replace(found, place=self.center + self.size * found.place)
        )

    def thin_fraction(self, thickness: float, device: wp.Device) -> float:
        """Return the fraction of the surface where the solid is thin.

        Thinner than `thickness`, by area, in the mesh's units.
        """
        area = np.linalg.norm(_double_areas(self.vertices, self.triangles), axis=1)
        return float(area[self._is_thin(thickness, device)].sum() / area.sum())

    def thin_part(self, thickness: float, device: wp.Device) -> wp.Mesh:
        """Return the triangles on thin parts as a mesh for Warp queries.

        Parts are thin if the solid is thinner than `thickness`, in the mesh's units.

        Coordinates are those of `on_device`. At least one triangle must be thin.
        """
        points = wp.array((self.vertices - self.center) / self.size, dtype=wp.vec3, device=device)
        thin = self.triangles[self._is_thin(thickness, device)]
        return wp.Mesh(points, wp.array(thin.ravel(), dtype=wp.int32, device=device))

    def _is_thin(self, thickness: float, device: wp.Device) -> np.ndarray:
        """Return a mask of the triangles where the solid is thinner than `thickness`."""
        faces = len(self.triangles)
        out = wp.empty(faces, dtype=wp.float32, device=device)
        reach = thickness / self.size
        wp.launch(
            mesh_thickness,
            dim=faces,
            inputs=[self.on_device(device).id, reach],
            outputs=[out],
            device=device,
        )
        return np.asarray(out.numpy() < np.float32(reach))


def load_surface(
    file: str, folder: Path | None = None, thickness: float | None = None
) -> ClosedSurface:
    """Return the surface named by a scene: a path or `builtin:` and a name.

    Paths are relative to `folder`.

    Args:
        file: the path or name.
        folder: folder of relative paths; the working directory without it.
        thickness: the file is an open mesh, the middle of a wall of this thickness, in the mesh's
            units.

    Raises:
        ValueError: there is no such file or builtin mesh, or it is not a closed surface; with
            `thickness`, it is one.
    """
    if file.startswith(BUILTIN_PREFIX):
        if thickness is not None:
            raise ValueError(f"{file}: thickness is for open meshes, and this mesh is closed")
        return builtin_mesh(file.removeprefix(BUILTIN_PREFIX))
    path = (folder or Path()) / Path(file).expanduser()
    if thickness is None:
        return read_mesh(path)
    vertices, triangles = read_triangles(path)
    return close_surface(*thickened(vertices, triangles, thickness, str(path)), str(path))


def thickened(
    vertices: np.ndarray, triangles: np.ndarray, thickness: float, name: str
) -> Triangles:
    """Return the closed surface of a wall whose middle is an open mesh.

    The mesh is shifted by half the thickness to both sides along the normals of its vertices. A
    strip joins both copies along the edges of the mesh. At a fold the shift is longer, so that both
    faces keep their distance: n / (n . m), where n is the vertex's normal and m that of the face
    with the largest angle to it, at most twice.

    Args:
        vertices: shape (n, 3).
        triangles: vertex indices, shape (m, 3).
        thickness: of the wall, in the units of the vertices.
        name: name of the mesh in messages.

    Raises:
        ValueError: the mesh is closed, has one side only, more than two triangles meet at an edge,
            or the thickness is not more than the distance at which vertices are merged.
    """
    vertices, triangles = weld(np.asarray(vertices, dtype=np.float64), np.asarray(triangles))
    triangles = triangles[~_flat(vertices, triangles)]
    least = 10.0 * WELD * _diagonal(vertices)
    if not thickness > least:
        raise ValueError(
            f"{name}: thickness = {thickness:.3g} in units of the mesh: must be more than a "
            f"hundred-thousandth of its diagonal, {least:.3g}"
        )
    edge, forward, uses = _edges(triangles)
    if (uses > 2).any():
        where = _first(vertices[triangles[(uses[edge] > 2).reshape(-1, 3).any(axis=1)]])
        raise ValueError(
            f"{name}: at an edge more than two triangles of the open mesh meet, {where}"
        )
    if (uses == 2).all():
        raise ValueError(f"{name}: thickness is for open meshes, and this mesh is closed")
    turn = _disagreeing(triangles, edge, forward, uses, name)
    triangles = np.where(turn[:, None], triangles[:, ::-1], triangles)
    areas = _double_areas(vertices, triangles)
    faces = areas / np.linalg.norm(areas, axis=1, keepdims=True)
    normal = np.zeros_like(vertices)
    for corner in range(3):
        # Faces count by their angle at the vertex: how a face is split does not matter.
        here, after, before = (np.roll(triangles, -corner, axis=1)[:, n] for n in range(3))
        one, other = vertices[after] - vertices[here], vertices[before] - vertices[here]
        angle = np.arctan2(
            np.linalg.norm(np.cross(one, other), axis=1), np.einsum("ij,ij->i", one, other)
        )
        np.add.at(normal, here, angle[:, None] * faces)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    least_cosine = np.ones(len(vertices))
    for corner in range(3):
        along = np.einsum("ij,ij->i", faces, normal[triangles[:, corner]])
        np.minimum.at(least_cosine, triangles[:, corner], along)
    shift = 0.5 * thickness * normal / np.maximum(least_cosine, 0.5)[:, None]
    # Edges of one triangle, in its direction.
    sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    edge, _, uses = _edges(triangles)
    a, b = sides[uses[edge] == 1].T
    n = len(vertices)
    strip = np.concatenate([np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)])
    return (
        np.concatenate([vertices + shift, vertices - shift]),
        np.concatenate([triangles, triangles[:, ::-1] + n, strip]),
    )


def builtin_mesh(name: str) -> ClosedSurface:
    """Return a built-in mesh of extent 1 around the origin.

    `torus` (axis z) or `knot` (a trefoil).

    Raises:
        ValueError: the name is unknown; the message lists those there are.
    """
    if name not in BUILTIN:
        raise ValueError(
            f"there is no mesh {BUILTIN_PREFIX}{name}; choose from "
            f"{', '.join(BUILTIN_PREFIX + known for known in sorted(BUILTIN))}"
        )
    vertices, triangles = BUILTIN[name]()
    return close_surface(vertices, triangles, BUILTIN_PREFIX + name)


def read_mesh(path: str | Path) -> ClosedSurface:
    """Read a closed surface from an OBJ, STL or PLY file.

    Polygons are triangulated, equal vertices merged.

    Raises:
        ValueError: the file is missing, unreadable, empty or not a closed surface; the message
            names it and says what to do.
    """
    vertices, triangles = read_triangles(Path(path))
    return close_surface(vertices, triangles, str(path))


def close_surface(vertices: np.ndarray, triangles: np.ndarray, name: str) -> ClosedSurface:
    """Check that triangles enclose a volume; repair orientation and duplicates.

    Degenerate triangles are removed.

    Args:
        vertices: shape (n, 3), in any unit.
        triangles: vertex indices, shape (m, 3).
        name: name of the mesh in messages.

    Raises:
        ValueError: not finite, without triangles, not closed, not orientable, or without volume.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    triangles = np.asarray(triangles, dtype=np.int64)
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise ValueError(
            f"{name}: {bad} of {len(vertices)} vertices {'is' if bad == 1 else 'are'} not finite "
            "(NaN or infinite coordinates)"
        )
    if not len(triangles):
        raise ValueError(f"{name}: the mesh has no triangles")
    if np.abs(vertices).max() > LARGEST:
        raise ValueError(
            f"{name}: a vertex lies {np.abs(vertices).max():.3g} from the origin: coordinates must "
            f"not be beyond {LARGEST:g}"
        )
    try:
        vertices, triangles = weld(vertices, triangles)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    warnings = []
    corners = np.sort(triangles, axis=1)
    keep = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])
    degenerate = int((~keep).sum())
    nothing = vertices[triangles[~keep]][:1]  # the first one's corners
    triangles = triangles[keep]
    if not len(triangles):
        raise ValueError(f"{name}: all {degenerate} triangles are degenerate (without area)")
    distinct = _without_repeated(triangles)
    if len(distinct) < len(triangles):
        again = np.setdiff1d(np.arange(len(triangles)), distinct)
        warnings.append(
            f"{name}: dropped {len(again)} repeated triangles, {_first(vertices[triangles[again]])}"
        )
        triangles = triangles[distinct]
    _check_closed(vertices, triangles, name)
    triangles, flipped = _orient(vertices, triangles, name)
    warnings += flipped
    # Only now: a triangle without area may close the seam between a long edge and its halves.
    flat = _flat(vertices, triangles)
    degenerate += int(flat.sum())
    if degenerate:
        where = _first(np.concatenate([nothing, vertices[triangles[flat]]]))
        warnings.append(
            f"{name}: dropped {degenerate} degenerate triangles (without area), {where}"
        )
    surface = ClosedSurface(
        name=name,
        vertices=vertices,
        triangles=triangles[~flat].astype(np.int32),
        warnings=tuple(warnings),
    )
    if not flat.all() and surface.volume > NO_VOLUME * _diagonal(vertices) ** 3:
        return surface
    raise ValueError(
        f"{name}: the surface encloses no volume (is it flat, or is every triangle there twice, in "
        "both orientations?)"
    )


def weld(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices closer than 1e-6 of the mesh's diagonal.

    Unused vertices are removed.

    Two vertices are linked if |x_i - x_j| <= WELD times the diagonal, in the mesh's units. Each
    connected component becomes its first vertex.

    Raises:
        ValueError: nearly all are that close together.
    """
    used, flat = np.unique(triangles, return_inverse=True)
    exact, same = np.unique(vertices[used], axis=0, return_inverse=True)
    tree, near = cKDTree(exact), WELD * _diagonal(exact)
    if len(exact) > CLOSE_VERTICES and tree.count_neighbors(tree, near) > (
        1 + CLOSE_VERTICES
    ) * len(exact):
        low, high = exact.min(axis=0), exact.max(axis=0)
        spans = f"the mesh spans {_point(low)} to {_point(high)}"
        raise ValueError(
            f"most vertices lie within {near:.3g} of others, where {spans}: is there an outlier?"
        )
    pairs = tree.query_pairs(near, output_type="ndarray")
    links = coo_array(
        (np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])),
        shape=(len(exact), len(exact)),
    )
    count, label = connected_components(links, directed=False)
    merged = np.empty((count, 3))
    merged[label[::-1]] = exact[::-1]  # the first of each group stays
    return merged, label[same.ravel()][flat].reshape(-1, 3)


def _diagonal(vertices: np.ndarray) -> float:
    return float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)))


def _double_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the normals of the triangles, of length twice their area, shape (m, 3)."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _flat(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Mark the triangles without area, shape (m,)."""
    corners = vertices[triangles]
    longest = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
    return np.linalg.norm(_double_areas(vertices, triangles), axis=1) <= FLAT * longest


def _cone_volumes(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the signed volumes of the tetrahedra of the origin and each triangle.

    The shape is (m,).
    """
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0


def _without_repeated(triangles: np.ndarray) -> np.ndarray:
    """Return the indices of triangles without duplicates of an earlier one.

    Duplicates have the same corners. Of triangles that exist in both orientations one is left where
    that closes the surface. Where it does not, as in a fin without thickness, both stay.
    """
    first = triangles.argmin(axis=1)[:, None]
    turned = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    once = np.sort(np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1])
    if len(once) < len(triangles) and not (_edges(triangles[once])[2] % 2).any():
        return once
    return np.sort(np.unique(turned, axis=0, return_index=True)[1])


def _point(point: np.ndarray) -> str:
    return f"[{', '.join(f'{coordinate:.4g}' for coordinate in point)}]"


def _first(corners: np.ndarray) -> str:
    """Return the place of the first of some triangles, as text.

    `corners` has the shape (m, 3, 3), in the mesh's units.
    """
    return f"the first at {_point(corners[0].mean(axis=0))}"


def _edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges of triangles.

    Returns each side's edge number and direction, shape (3 m,), with side s of triangle t at 3 t +
    s, and each edge's number of sides.
    """
    sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    forward = sides[:, 0] < sides[:, 1]
    _, edge, uses = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return edge.ravel(), forward, uses


def _check_closed(vertices: np.ndarray, triangles: np.ndarray, name: str) -> None:
    edge, _, uses = _edges(triangles)
    odd = int((uses % 2).sum())
    if odd:
        where = _first(vertices[triangles[(uses[edge] % 2).reshape(-1, 3).any(axis=1)]])
        raise ValueError(
            f"{name}: the surface is not closed: {odd} of its {len(uses)} edges are open, {where}, "
            "so inside and outside are undefined "
            "and the material would leak through. "
            "Fill the holes (in Blender: Mesh > Clean Up > Merge by Distance, Fill Holes; in "
            "MeshLab: Close Holes), or give its thickness if it is the middle of a wall"
        )


def _orient(vertices: np.ndarray, triangles: np.ndarray, name: str) -> tuple[np.ndarray, list[str]]:
    """Turn triangles until neighbors agree and every part faces outward.

    The inner wall of a hollow part faces into the hollow.
    """
    warnings = []
    edge, forward, uses = _edges(triangles)
    balance = np.bincount(edge, weights=np.where(forward, 1.0, -1.0))
    if balance.any():
        turn = _disagreeing(triangles, edge, forward, uses, name)
        triangles = np.where(turn[:, None], triangles[:, ::-1], triangles)
        edge, forward, uses = _edges(triangles)
        tangled = int(np.count_nonzero(np.bincount(edge, weights=np.where(forward, 1.0, -1.0))))
        if tangled:
            raise ValueError(
                f"{name}: at {tangled} edges more than two triangles meet without a consistent "
                "orientation, so inside and outside are "
                "undefined. Separate the parts that touch there, or repair the mesh (in MeshLab: "
                "Repair non Manifold Edges)"
            )
        where = _first(vertices[triangles[turn]])
        warnings.append(
            f"{name}: turned {int(turn.sum())} of {len(triangles)} triangles that disagreed with "
            f"their neighbors' orientation, {where}"
        )
    parts, part = _parts(edge, forward, uses)
    volume = np.bincount(
        part, weights=_cone_volumes(vertices - vertices.mean(axis=0), triangles), minlength=parts
    )
    turn = np.zeros(parts, dtype=bool)
    if volume.sum() < 0.0:
        turn[:] = True
    outward = np.where(turn, -volume, volume)
    # A hollow is one only inside another part.
    for p in np.flatnonzero(outward < 0.0):
        others = part != p
        corners = vertices[
            np.where(turn[part[others]][:, None], triangles[others][:, ::-1], triangles[others])
        ]
        turn[p] ^= winding_number(vertices[triangles[part == p][0, 0]], corners) < 0.5
    if turn.any():
        where = _first(vertices[triangles[turn[part]]])
        what = (
            "the mesh was inside out"
            if turn.all()
            else f"{int(turn.sum())} of its {parts} parts were inside out, {where}"
        )
        warnings.append(f"{name}: {what}; turned")
        triangles = np.where(turn[part][:, None], triangles[:, ::-1], triangles)
    return triangles, warnings


def _parts(edge: np.ndarray, forward: np.ndarray, uses: np.ndarray) -> tuple[int, np.ndarray]:
    """Number the closed parts of a balanced surface.

    Returns the number of parts and each triangle's part, shape (m,).
    """
    owner = np.arange(edge.size) // 3
    order = np.argsort(edge, kind="stable")

    def components(edges: np.ndarray) -> tuple[int, np.ndarray]:
        neighbors = (edge[order[1:]] == edge[order[:-1]]) & edges[edge[order[1:]]]
        rows, columns = owner[order[1:]][neighbors], owner[order[:-1]][neighbors]
        links = coo_array(
            (np.ones(rows.size, dtype=bool), (rows, columns)), shape=(owner[-1] + 1, owner[-1] + 1)
        )
        return connected_components(links, directed=False)

    parts, part = components(uses == 2)
    # Where more than two triangles meet, parts are joined only if none of them is balanced there by
    # itself (they do more than touch).
    meetings, meeting = np.unique(edge * parts + part[owner], return_inverse=True)
    unbalanced = (
        meetings[np.bincount(meeting.ravel(), weights=np.where(forward, 1.0, -1.0)) != 0.0] // parts
    )
    return components((uses == 2) | np.isin(np.arange(uses.size), unbalanced))


def _disagreeing(
    triangles: np.ndarray, edge: np.ndarray, forward: np.ndarray, uses: np.ndarray, name: str
) -> np.ndarray:
    """Mark the fewest triangles to turn so that all neighbors agree, shape (m,).

    Neighbors are two triangles at an edge of two. Every triangle t appears as t (kept) and t + m
    (turned). Neighbors that agree are linked like with like, others crosswise. The connected parts
    of this double cover are the consistent choices, and a triangle linked with its own turned self
    lies on a one-sided surface.
    """
    m = len(triangles)
    order = np.argsort(edge, kind="stable")
    order = order[uses[edge[order]] == 2].reshape(-1, 2)
    t, s = order[:, 0] // 3, order[:, 1] // 3
    crosswise = m * (forward[order[:, 0]] == forward[order[:, 1]])
    rows, columns = np.concatenate([t, t + m]), np.concatenate([s + crosswise, s + m - crosswise])
    _, label = connected_components(
        coo_array((np.ones(rows.size, dtype=bool), (rows, columns)), shape=(2 * m, 2 * m)),
        directed=False,
    )
    unflipped, flipped = label[:m], label[m:]
    if (unflipped == flipped).any():
        raise ValueError(
            f"{name}: the surface has one side only (like a Klein bottle), so inside and outside "
            "are undefined"
        )
    group, bit = np.minimum(unflipped, flipped), unflipped > flipped
    majority = 2 * np.bincount(group, weights=bit) > np.bincount(group)
    return bit ^ majority[group]


def winding_number(point: np.ndarray, corners: np.ndarray) -> float:
    """Return the winding number of triangles about a point.

    `corners` of shape (m, 3, 3); the sum of their solid angles over 4 pi.

    By van Oosterom and Strackee's formula, the tangent of half a solid angle is a.(b x c) /
    (|a||b||c| + (a.b)|c| + (b.c)|a| + (c.a)|b|).
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a)))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    return float(
        np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2.0 * np.pi)
    )
