"""Surfaces for films: this program's beside pysplashsurf's.

Run `python -m benchmarks.surfaces [--seed N] [--frames FOLDER] [--picture FILE]` in the source
tree, for pysplashsurf after `pip install pysplashsurf`.

Three liquids are simulated in 3-D and stored 24 times a second: a dam that breaks over a pillar, a
drop that falls into a pool, and a sheet that is poured. Both programs wrap the same particles. The
tables have

- beads: RMS distance of the mesh from the plane and the sphere that the particles were cut at
  [cells]. The particles are those of a stirred tank, so that a part is the noise of the cut;
- flicker: RMS change of the mesh along its normal [cells] between two frames of a pool at rest, and
  between the same particles moved by parts of a cell, as in a steady current;
- volume: enclosed volume over that of the particles;
- lace: separate surfaces, cavities among them, and handles (the holes of a sheet): the sum of the
  genus of all surfaces, pieces - (points - edges + triangles) / 2;
- CPU seconds of a frame, least of `REPEAT`, one thread, and the peak of memory above that before.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from warp_lcp.benchmarks.harness.machine import forget_peak, resident_bytes
from warp_lcp.benchmarks.harness.record import RecordTable
from warp_lcp.benchmarks.harness.report import markdown
from warp_lcp.files import Tables
from warp_lcp.fluids import SIMULATOR, LiquidScene
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.surface_mesh import SurfaceMesh

RATE, PER_AXIS, REPEAT = 24, 2, 3
MISSING = "pysplashsurf is missing (pip install pysplashsurf): only this program's surfaces\n"
LEVEL, RADIUS = 14.0, 8.0  # height of the plane and radius of the sphere in the tank [cells]
CENTER = np.array([16.3, 12.4, 15.7])  # of the sphere [cells]
MARGIN = 5.0  # distance from the sides of the points whose height counts [cells]
MOVES = np.outer((1, 2, 3), (0.37, 0.11, 0.21))  # of the current [cells]

Mesh = tuple[np.ndarray, np.ndarray]  # points [m], shape (n, 3), and corners, shape (m, 3)
Film = Mapping[int, np.ndarray]  # particles [m] of each frame
Wrap = Callable[[np.ndarray], Mesh]  # particles [m], shape (n, 3), to their mesh


@dataclass(frozen=True)
class FilmScene:
    """Liquid and the frames of it that are wrapped."""

    size: tuple[float, float, float]  # domain [m]
    resolution: int
    frames: tuple[int, ...]
    tables: Tables
    wall: str = "separating"

    @property
    def spacing(self) -> float:
        """Return the length of a cell [m]."""
        return max(self.size) / self.resolution

    def particles(self, seed: int) -> dict[int, np.ndarray]:
        """Return the particles of each frame [m], float32, shape (n, 3).

        Args:
            seed: seed of the particles' places.
        """
        data: Tables = {
            "scene": {"simulator": "fluids"},
            "time": {"duration": 10.0, "frames_per_second": RATE},
            "domain": {"size": list(self.size), "resolution": self.resolution, "wall": self.wall},
            "particles": {"seed": seed},
        }
        scene = LiquidScene.model_validate(data | self.tables)
        simulation = SIMULATOR.create(scene, device="cpu", folder=Path())
        found = {}
        for frame in range(1, max(self.frames) + 1):
            while simulation.time < frame / RATE - 1e-9:
                simulation.step(min(simulation.stable_dt(), frame / RATE - simulation.time))
            if frame in self.frames:
                found[frame] = simulation.particles.position.numpy().astype(np.float32)
        return found


def _box(low: Sequence[float], high: Sequence[float], **properties: object) -> Tables:
    return {"shape": "box", "min": list(low), "max": list(high), **properties}


SCENES = {
    "dam break": FilmScene(
        (1.6, 0.8, 0.8),
        64,
        (10, 15, 20),
        {
            "liquid": [_box((0.0, 0.0, 0.0), (0.4, 0.5, 0.8))],
            "solid": [_box((0.9, 0.0, 0.3), (1.0, 0.4, 0.5))],
        },
    ),
    "drop": FilmScene(
        (1.0, 1.0, 1.0),
        32,
        (6, 10, 14),
        {
            "liquid": [
                _box((0.0, 0.0, 0.0), (1.0, 0.35, 1.0)),
                {
                    "shape": "sphere",
                    "center": [0.5, 0.6, 0.5],
                    "radius": 0.13,
                    "velocity": [0.0, -3.0, 0.0],
                },
            ]
        },
        "free-slip",
    ),
    "poured sheet": FilmScene(
        (0.6, 1.2, 0.6),
        72,
        (8, 12, 16),
        {"source": [_box((0.1, 1.15, 0.2667), (0.5, 1.2, 0.3), velocity=[0.0, -1.0, 0.0])]},
    ),
}
REST = FilmScene(
    (1.0, 0.5, 1.0), 32, (10, 11, 12), {"liquid": [_box((0.0, 0.0, 0.0), (1.0, 0.3, 1.0))]}
)
TANK = FilmScene(
    (1.0, 1.0, 1.0),
    32,
    (24,),
    {
        "liquid": [
            _box((0.0, 0.0, 0.0), (0.5, 0.8, 1.0), velocity=[0.0, 2.0, 1.0]),
            _box((0.5, 0.0, 0.0), (1.0, 0.8, 1.0), velocity=[0.0, -2.0, -1.0]),
        ]
    },
    "free-slip",
)


def ours(scene: FilmScene, *, resolution: int | None = None, smoothing: float = 1.5) -> Wrap:
    """Return this program's surface, without the solids of the scene."""
    counts = [round(side / scene.spacing) for side in scene.size]
    grid = StaggeredGrid((counts[0], counts[1], counts[2]), scene.spacing, 3, "cpu")
    surface = SurfaceMesh(grid, per_axis=PER_AXIS, resolution=resolution, smoothing=smoothing)

    def wrap(x: np.ndarray) -> Mesh:
        mesh = surface.find(wp.array(x, dtype=wp.vec3, device="cpu"))
        return mesh.points.numpy().astype(np.float64), mesh.corners.numpy().astype(np.int64)

    return wrap


def splashsurf(scene: FilmScene, *, length: float, threshold: float) -> Wrap:
    """Return pysplashsurf's surface: marching cubes, cleaned, and weighted Laplacian smoothing.

    Args:
        scene: the scene; the radius of a particle is half the distance of particles.
        length: smoothing length of its kernel [radii].
        threshold: value of the surface.

    Raises:
        ImportError: pysplashsurf is not installed.
    """
    import pysplashsurf

    def wrap(x: np.ndarray) -> Mesh:
        found, _ = pysplashsurf.reconstruction_pipeline(
            x,
            particle_radius=0.5 * scene.spacing / PER_AXIS,
            smoothing_length=length,
            cube_size=1.0,
            iso_surface_threshold=threshold,
            multi_threading=False,
            mesh_cleanup=True,
            mesh_smoothing_iters=25,
            mesh_smoothing_weights=True,
        )
        mesh = found.mesh
        return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.triangles, np.int64)

    return wrap


Method = Callable[[FilmScene], Wrap]

OURS: dict[str, Method] = {
    "this program": ours,
    "smoothing 2": functools.partial(ours, smoothing=2.0),
    "resolution 4": functools.partial(ours, resolution=4),
}
# The length and the threshold of its manual, then those that suit particles of this program.
SPLASHSURF: dict[str, Method] = {
    f"pysplashsurf {length:g}, {threshold:g}": functools.partial(
        splashsurf, length=length, threshold=threshold
    )
    for length, threshold in ((2.0, 0.6), (3.0, 0.5), (3.5, 0.5))
}


def methods() -> dict[str, Method]:
    """Return the methods by name; pysplashsurf's if it is installed."""
    try:
        splashsurf(REST, length=2.0, threshold=0.6)
    except ImportError:
        sys.stderr.write(MISSING)
        return dict(OURS)
    return OURS | SPLASHSURF


def volume(mesh: Mesh) -> float:
    """Return the enclosed volume [m^3], by the divergence theorem."""
    x = mesh[0][mesh[1]]
    return float((x[:, 0] * np.cross(x[:, 1], x[:, 2])).sum() / 6.0)


@dataclass(frozen=True)
class Lace:
    """Topology of closed triangles."""

    pieces: int  # connected surfaces
    cavities: int  # those that enclose air
    handles: int  # sum of the genus of all pieces


def lace(mesh: Mesh) -> Lace:
    """Return the number of pieces, cavities and handles of closed triangles.

    A piece is a cavity if its triangles face inward. With V points, E edges and F triangles, 3 F =
    2 E, and the genus of all pieces is pieces - (V - E + F) / 2.
    """
    points, corners = mesh
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    graph = coo_array((np.ones(len(ends)), ends.T), shape=2 * (len(points),))
    label = connected_components(graph, directed=False)[1]
    used = np.unique(corners)
    x = points[corners]
    parts = np.bincount(
        label[corners[:, 0]], (x[:, 0] * np.cross(x[:, 1], x[:, 2])).sum(axis=1), label.max() + 1
    )
    pieces = len(np.unique(label[used]))
    euler = len(used) - len(corners) / 2.0
    return Lace(pieces, int((parts < 0.0).sum()), round(pieces - euler / 2.0))


def normals(mesh: Mesh) -> np.ndarray:
    """Return a unit normal for each point, shape (n, 3): that of its triangles by their areas."""
    points, corners = mesh
    x = points[corners]
    areas = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    sums = np.zeros_like(points)
    for side in corners.T:
        np.add.at(sums, side, areas)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)


def rms_change(before: Mesh, after: Mesh, counts: np.ndarray) -> float:
    """Return the RMS distance of points of a mesh from another one, along its normal.

    To the tangent plane at the nearest point; the error is of second order in the size of a
    triangle.

    Args:
        before: the mesh with the points.
        after: the other mesh.
        counts: which points count, bool, shape (points of `before`,).
    """
    points = before[0][counts]
    nearest = cKDTree(after[0]).query(points)[1]
    along = np.einsum("ij,ij->i", points - after[0][nearest], normals(after)[nearest])
    return float(np.sqrt((along**2).mean()))


def upper(mesh: Mesh, scene: FilmScene, least: float) -> np.ndarray:
    """Return which points lie above a height [cells] and away from the sides."""
    x = mesh[0] / scene.spacing
    size = np.array(scene.size) / scene.spacing
    inside = (x > MARGIN) & (x < size - MARGIN)
    return inside[:, 0] & inside[:, 2] & (x[:, 1] > least)


def beads(wrap: Wrap, x: np.ndarray) -> dict[str, float]:
    """Return the RMS distance from a plane and a sphere [cells] of a stirred tank's particles."""
    cell = TANK.spacing
    pool = wrap(x[x[:, 1] < LEVEL * cell])
    heights = pool[0][upper(pool, TANK, LEVEL - 2.0), 1] / cell
    ball = wrap(x[np.linalg.norm(x / cell - CENTER, axis=1) < RADIUS])
    radii = np.linalg.norm(ball[0] / cell - CENTER, axis=1)
    radii = radii[radii > RADIUS - 2.0]  # without cavities
    return {"pool": float(heights.std()), "ball": float(radii.std())}


def flicker(make: Method, films: Mapping[str, Film]) -> dict[str, float]:
    """Return the RMS change [cells] of a pool at rest and of one that a current moves."""
    wrap, cell = make(REST), REST.spacing
    meshes = [wrap(x) for x in films["rest"].values()]
    rest = [rms_change(a, b, upper(a, REST, 5.0)) / cell for a, b in itertools.pairwise(meshes)]
    wrap, cell = make(TANK), TANK.spacing
    x = films["tank"][TANK.frames[0]]
    sides = (x > MARGIN * cell) & (x < 1.0 - MARGIN * cell)
    x = x[sides[:, 0] & sides[:, 2] & (x[:, 1] < LEVEL * cell)]
    first = wrap(x)
    away = np.abs(first[0] - 0.5).max(axis=1, where=[True, False, True], initial=0.0)
    counts = (away < 0.5 - (MARGIN + 2.0) * cell) & (first[0][:, 1] > (LEVEL - 2.0) * cell)
    current = []
    for move in MOVES * cell:
        points, corners = wrap((x + move).astype(np.float32))
        current.append(rms_change(first, (points - move, corners), counts) / cell)
    return {"rest": rms(rest), "current": rms(current)}


def rms(values: Sequence[float]) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def cost(make: Method, scene: FilmScene, x: np.ndarray) -> tuple[float, float]:
    """Return CPU seconds and MB of a frame."""
    make(scene)(x)  # loads kernels
    forget_peak()
    before = resident_bytes()
    wrap = make(scene)
    seconds = []
    for _ in range(REPEAT):
        start = time.process_time()
        wrap(x)
        seconds.append(time.process_time() - start)
    return min(seconds), (resident_bytes(peak=True) - before) / 1e6


def films(folder: Path | None, seed: int) -> dict[str, Film]:
    """Return the particles of all scenes; simulated, or from a folder that keeps them."""
    found: dict[str, Film] = {}
    for name, scene in {"rest": REST, "tank": TANK, **SCENES}.items():
        path = None if folder is None else folder / f"{name.replace(' ', '-')}-{seed}.npz"
        if path is not None and path.exists():
            with np.load(path) as stored:
                found[name] = {frame: stored[str(frame)] for frame in scene.frames}
            continue
        found[name] = scene.particles(seed)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            arrays = {str(frame): x for frame, x in found[name].items()}
            np.savez(path, **arrays)  # type: ignore[arg-type]
    return found


def tables(particles: Mapping[str, Film]) -> Iterator[RecordTable]:
    """Measure, and return the tables."""
    chosen = methods()
    dam, frame = SCENES["dam break"], SCENES["dam break"].frames[1]
    x = particles["dam break"][frame]
    rows = []
    for name, make in chosen.items():
        bumps = beads(make(TANK), particles["tank"][TANK.frames[0]])
        change = flicker(make, particles)
        seconds, memory = cost(make, dam, x)
        row = [f"{bumps['pool']:.3f}", f"{bumps['ball']:.3f}"]
        row += [f"{change['rest']:.1e}", f"{change['current']:.4f}"]
        rows.append([name, *row, f"{seconds:.2f}", f"{memory:.0f}"])
    columns = ["surface", "beads: pool", "ball", "flicker: rest", "current", "s a frame", "MB"]
    remark = f"Beads and flicker in cells; seconds and MB for the dam's {len(x):,} particles."
    yield RecordTable("Calm liquid", columns, rows, remark)
    rows = []
    for name, scene in SCENES.items():
        for method, make in chosen.items():
            wrap, cells = make(scene), []
            for x in particles[name].values():
                mesh = wrap(x)
                true = len(x) * (scene.spacing / PER_AXIS) ** 3
                found = lace(mesh)
                error = 100.0 * (volume(mesh) / true - 1.0)
                cells.append(f"{error:+.1f} %, {found.pieces}, {found.cavities}, {found.handles}")
            rows.append([name, method, *cells])
    columns = ["scene", "surface", "first frame", "second", "third"]
    shown = "; ".join(
        f"{name}: frames {', '.join(map(str, scene.frames))}" for name, scene in SCENES.items()
    )
    remark = f"Error of the volume, pieces, cavities among them, handles. {shown}."
    yield RecordTable("Splashes and sheets", columns, rows, remark)


def picture(particles: Mapping[str, Film], path: Path) -> None:
    """Draw the dam and the sheet by this program and by pysplashsurf, side by side."""
    import pyvista

    cameras = {
        "dam break": ((2.6, 1.15, 2.2), (0.95, 0.25, 0.4)),
        "poured sheet": ((1.5, 0.9, 1.9), (0.3, 0.55, 0.3)),
    }
    shown: dict[str, Method] = {
        "this program": ours,
        "pysplashsurf 3, 0.5": SPLASHSURF["pysplashsurf 3, 0.5"],
    }
    plotter = pyvista.Plotter(off_screen=True, shape=(1, 4), window_size=(1840, 460), border=False)
    views = [(name, title) for name in cameras for title in shown]
    for column, (name, title) in enumerate(views):
        scene = SCENES[name]
        points, corners = shown[title](scene)(particles[name][scene.frames[2 - (column < 2)]])
        plotter.subplot(0, column)
        faces = np.concatenate([np.full((len(corners), 1), 3), corners], axis=1)
        plotter.add_mesh(
            pyvista.PolyData(points, faces.ravel()),
            color="#7db4dc",
            smooth_shading=True,
            specular=0.5,
            specular_power=25,
        )
        plotter.add_text(title.split(" 3")[0], font_size=9)
        plotter.camera_position = (*cameras[name], (0.0, 1.0, 0.0))
    plotter.screenshot(str(path))
    plotter.close()


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="seed of the particles")
    parser.add_argument("--frames", type=Path, help="folder that keeps the particles")
    parser.add_argument("--picture", type=Path, help="PNG of both programs side by side")
    arguments = parser.parse_args()
    particles = films(arguments.frames, arguments.seed)
    for table in tables(particles):
        sys.stdout.write("\n".join([f"## {table.title}", "", *markdown(table), "", ""]))
        sys.stdout.flush()
    if arguments.picture is not None:
        picture(particles, arguments.picture)


if __name__ == "__main__":
    main()
