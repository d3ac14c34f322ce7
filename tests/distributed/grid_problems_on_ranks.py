"""Grid problems solved on all ranks and, on each, by itself.

`test_grids_on_ranks` runs this program.
"""

import sys
from functools import partial
from itertools import product
from unittest import mock

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.distributed.decomposition import CellBox, Decomposition
from warp_lcp.distributed.halo import Halo
from warp_lcp.distributed.interruptible_wait import waiting
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.kernels.launch_graph import HostTask, run_table
from warp_lcp.kernels.thread_pool import OperationTable
from warp_lcp.multigrid import halo_levels
from warp_lcp.multigrid.multiple_semicoarsening import make_hierarchy
from warp_lcp.multigrid.stencil_level import StencilLevel

rng = np.random.default_rng(7301)


def scene(shape, *, solids=0.08, air=True):
    """Return random solids in liquid, with air above its surface."""
    cells = np.where(rng.random(shape) < solids, wl.SOLID, wl.FLUID)
    if air:
        height = shape[-2] * (0.55 + 0.2 * np.sin(np.arange(shape[-1]) / 3.0))
        cells[..., np.arange(shape[-2])[:, None] > height[None, :]] = wl.AIR
    return cells


def coefficients(shape):
    """Return face coefficients over two decades, some 0, and a shift.

    float32 represents them exactly.
    """
    found = {}
    for name, axis in zip(("face_x", "face_y", "face_z"), range(len(shape)), strict=False):
        size = list(shape)
        size[-1 - axis] += 1
        faces = 10.0 ** rng.uniform(-1, 1, size)
        found[name] = np.where(rng.random(size) < 0.1, 0.0, faces)
    found["shift"] = np.where(rng.random(shape) < 0.05, rng.random(shape), 0.0)
    return {name: values.astype(np.float32).astype(np.float64) for name, values in found.items()}


def part(values, box, shape, axis=None):
    """Return this rank's part of a field, or of the faces along an axis.

    Faces include those at its upper sides.
    """
    if np.ndim(values) == 0:
        return values
    slices = [
        slice(l, h + (a == axis)) for a, (l, h) in enumerate(zip(box.low, box.high, strict=True))
    ][: len(shape)]
    return np.ascontiguousarray(values[tuple(reversed(slices))])


def columns(shape, count):
    """Return columns that are nonzero on one blob each, and weights over two decades.

    The blobs lie anywhere relative to the cuts.
    """
    where, found = np.indices(shape), []
    for _ in range(count):
        center, radius = rng.random(len(shape)) * shape, rng.uniform(1.5, 0.3 * min(shape))
        near = np.sqrt(sum((w - c) ** 2 for w, c in zip(where, center, strict=True)))
        found.append(
            np.where((near > 0.6 * radius) & (near < radius), rng.standard_normal(shape), 0.0)
        )
    root = rng.standard_normal((count, count))
    return np.stack(found, axis=-1), 10.0 ** rng.uniform(-1, 1) * root @ root.T


def joined(A, columns, box):
    """Return this rank's box of an operator, with a term of columns if there are any."""
    if columns is None:
        return A
    U, W = columns
    mine = [slice(l, h) for l, h in zip(box.low, box.high, strict=True)][: U.ndim - 1]
    return wl.SumOperator(A, wl.LowRankOperator(U[tuple(reversed(mine))], W, device="cpu"))


def compare(
    ranks,
    name,
    cells,
    b,
    lower,
    upper=np.inf,
    *,
    method,
    decomposition=None,
    rtol=1e-9,
    same=1e-7,
    columns=None,
    counts_differ=1,
    others=(),
    **faces,
):
    """Solve on all ranks and on one, and compare.

    Statuses are equal (CONVERGED, INFEASIBLE or `others`), counts differ by at most one, and x by
    rounding.
    """
    shape = cells.shape
    counts = (*reversed(shape), 1)[:3]
    boxes = decomposition or Decomposition(counts, ranks)
    axes = {"face_x": 0, "face_y": 1, "face_z": 2}
    mine = {key: part(value, boxes.box, shape, axes.get(key)) for key, value in faces.items()}
    A = wl.GridPoisson(part(cells, boxes.box, shape), decomposition=boxes, device="cpu", **mine)
    own = (part(field, boxes.box, shape) for field in (b, lower, upper))
    problem = wl.LCP(joined(A, columns, boxes.box), *own)
    stopping = wl.StoppingCriteria(rtol=rtol)
    found = wl.solve(problem, wl.default_chain(method, problem), stopping=stopping)
    whole = CellBox((0, 0, 0), counts)
    alone = wl.LCP(
        joined(wl.GridPoisson(cells, device="cpu", **faces), columns, whole), b, lower, upper
    )
    expected = wl.solve(alone, wl.default_chain(method, alone), stopping=stopping)
    assert found.status is expected.status, (name, found.status, expected.status)
    assert abs(found.iterations - expected.iterations) <= counts_differ, (
        name,
        found.iterations,
        expected.iterations,
    )
    # Both start from the same residual and take the same steps at first. Step lengths and
    # directions come from sums over all ranks.
    ours, theirs = (np.array([r.residual for r in result.history]) for result in (found, expected))
    assert np.isclose(ours[0], theirs[0], rtol=1e-12), name
    way = min(len(ours), len(theirs), 4)  # later, rounding may move cells between the sets
    assert np.allclose(ours[:way], theirs[:way], rtol=1e-3, atol=1e-300), (
        name,
        ours[:way],
        theirs[:way],
    )
    own, whole = found.x.numpy(), expected.x.numpy()
    error = ranks.max(float(np.abs(own - part(whole, boxes.box, shape)).max(initial=0.0)))
    scale = max(float(np.abs(whole).max()), 1e-300)
    assert expected.status in (wl.SolveStatus.CONVERGED, wl.SolveStatus.INFEASIBLE, *others), (
        name,
        expected.status,
    )
    assert not expected or error <= same * scale, (name, error / scale)
    return found, problem.A


PM, NEWTON = wl.ProjectedMultigrid(), wl.MinimumMapNewton()


def shapes(ranks):
    """Compare shapes, methods, bounds and coefficients."""
    for shape in ((34, 21, 40), (17, 13, 11), (48, 37), (65, 64)):
        cells = scene(shape)
        b = rng.standard_normal(shape)
        for method in (PM, NEWTON):
            compare(ranks, f"everywhere {shape}", cells, b, 0.0, method=method)
            compare(ranks, f"boxed {shape}", cells, b, -0.2, 0.3, method=method)
            compare(ranks, f"linear {shape}", cells, b, -np.inf, method=method)
            walls = np.where(rng.random(shape) < 0.3, 0.0, -np.inf)
            compare(ranks, f"walls {shape}", cells, b, walls, method=method, **coefficients(shape))
            compare(
                ranks,
                f"number a face {shape}",
                cells,
                b,
                0.0,
                method=method,
                face_x=1.0,
                face_y=3.0,
            )
            # One finite value on some ranks only.
            alike = np.where(np.indices(shape)[0] < shape[0] // 2, walls, -rng.random(shape))
            compare(ranks, f"bounds alike on some ranks {shape}", cells, b, alike, method=method)


def rounded_on_one_rank(ranks):
    """Status of all ranks if one has a coefficient that float32 rounds."""
    shape = (34, 21, 40)
    face = np.ones((34, 21, 41))
    face[3, 4, 5] = 0.3
    for method in (PM, NEWTON):
        result, _ = compare(
            ranks,
            "rounded",
            scene(shape),
            rng.standard_normal(shape),
            0.0,
            method=method,
            rtol=1e-10,
            face_x=face,
            others=(wl.SolveStatus.FLOOR,),
        )
        assert result.status is wl.SolveStatus.FLOOR, result.status


def low_rank(ranks):
    """Compare low-rank terms whose columns cross cuts or belong to another rank."""
    for shape in ((17, 13, 24), (48, 37)):
        cells = scene(shape)
        b = rng.standard_normal(shape)
        walls = np.where(rng.random(shape) < 0.3, 0.0, -np.inf)
        for method in (PM, NEWTON):
            compare(
                ranks,
                f"columns {shape}",
                cells,
                b,
                -np.inf,
                method=method,
                columns=columns(shape, 5),
            )
            compare(
                ranks,
                f"columns, walls {shape}",
                cells,
                b,
                walls,
                method=method,
                columns=columns(shape, 3),
                counts_differ=3,
            )


def other_cuts(ranks):
    """Compare cuts along x and y, and at odd cells.

    The finest level is then gathered.
    """
    if ranks.size > 1:
        shape, cells = (20, 20, 20), scene((20, 20, 20))
        b = rng.standard_normal(shape)
        for processes in ((ranks.size, 1, 1), (1, ranks.size, 1)):
            boxes = Decomposition(
                (20, 20, 20),
                ranks,
                processes=processes,
                cuts=[
                    [20] if p == 1 else [7, *[5] * (p - 2), 20 - 7 - 5 * (p - 2)] for p in processes
                ],
            )
            compare(ranks, f"odd cuts {processes}", cells, b, 0.0, method=PM, decomposition=boxes)
        cells = scene((40, 40, 40))
        b = rng.standard_normal((40, 40, 40))
        for processes in ((ranks.size, 1, 1), (1, ranks.size, 1)):
            compare(
                ranks,
                f"cuts {processes}",
                cells,
                b,
                0.0,
                method=PM,
                decomposition=Decomposition((40, 40, 40), ranks, processes=processes),
            )


def closed_pools(ranks):
    """Compare closed pools: one on all ranks, and small ones.

    b sums to 0 on each or not.
    """
    cells = np.full((24, 10, 12), wl.FLUID)
    cells[:, 6, :] = wl.SOLID
    cells[:, 7:, 6] = wl.SOLID
    cells[3, 9, 9] = wl.AIR
    b = rng.standard_normal(cells.shape)
    for region in (
        (slice(None), slice(0, 6), slice(None)),
        (slice(None), slice(7, None), slice(0, 6)),
    ):
        b[region] -= b[region].mean()
    for method in (PM, NEWTON):
        result, A = compare(ranks, "closed pools", cells, b, -np.inf, method=method, same=1e-8)
        assert A.floating_components().count == 2
        compare(ranks, "closed pools, bounded", cells, b + 0.1, 0.0, method=method, same=1e-8)
        piston = np.zeros((*cells.shape, 1))
        piston[:, 5, :] = 1.0 / 288.0  # its product with the pool beneath it is no null space
        result, A = compare(
            ranks, "a piston", cells, b, -np.inf, method=method, columns=(piston, np.ones((1, 1)))
        )
        assert A.floating_components().count == 1
    result, A = compare(ranks, "no solution", cells, b + 1.0, -np.inf, method=PM)
    assert result.status is wl.SolveStatus.INFEASIBLE


def memory_in_place(ranks):
    """Solve with the same memory while cells and b change in place."""
    shape = (32, 18, 18)
    boxes = Decomposition((18, 18, 32), ranks)
    full = [scene(shape) for _ in range(4)]
    nz, ny, nx = reversed(boxes.box.counts)
    stored = wp.zeros((nz + 2, ny + 2, nx + 2), dtype=wp.float64, device="cpu")
    A = wl.GridPoisson(part(full[0], boxes.box, shape), decomposition=boxes, device="cpu")
    problem = wl.LCP(A, stored, 0.0)
    work = PM.init(problem)
    for cells in full:
        b = rng.standard_normal(shape)
        padded = np.zeros(stored.shape, dtype=np.int8)
        padded[1:-1, 1:-1, 1:-1] = part(cells, boxes.box, shape)
        A.update(wp.array(padded, dtype=wp.int8, device="cpu"))
        stored.numpy()[1:-1, 1:-1, 1:-1] = part(b, boxes.box, shape)
        guess = None
        for _ in range(2):  # the second time warm
            result = wl.solve(
                problem, PM, workspace=work, stopping=wl.StoppingCriteria(rtol=1e-9), x0=guess
            )
            guess = result.x
        expected = wl.solve(
            wl.LCP(wl.GridPoisson(cells, device="cpu"), b, 0.0),
            PM,
            stopping=wl.StoppingCriteria(rtol=1e-9),
        )
        assert result and expected
        inner = result.x.numpy()[1:-1, 1:-1, 1:-1]
        assert (
            np.abs(inner - part(expected.x.numpy(), boxes.box, shape)).max()
            <= 1e-7 * np.abs(expected.x.numpy()).max()
        )


def as_on_devices(ranks):
    """Compare with ghost cells through host memory and unfused cycles."""
    fill, filling, fuses = Halo.fill, Halo.fill_task, StencilLevel.fuses
    Halo.fill_task = lambda self, field: HostTask(partial(self.fill, field))
    Halo.fill = lambda self, field: (
        self._fill_through_host(field.reshape(self.shape))
        if isinstance(field, wp.array)
        else fill(self, field)
    )
    StencilLevel.fuses = False
    cells = scene((34, 21, 40))
    b = rng.standard_normal(cells.shape)
    for method in (PM, NEWTON):
        compare(ranks, "as on a device", cells, b, 0.0, method=method, **coefficients(cells.shape))
    Halo.fill, Halo.fill_task, StencilLevel.fuses = fill, filling, fuses


def legs(ranks):
    """Compare fused legs of cycles with unfused ones, linear and projected.

    On any cuts and with any number of threads.
    """
    shape, gathered = (32, 40, 48), halo_levels.GATHERED
    cells, faces = scene(shape), coefficients(shape)
    free, b, gaps = rng.random(shape) < 0.9, rng.standard_normal(shape), rng.random((2, *shape))
    halo_levels.GATHERED = 64
    cuts = {
        (1, 1, ranks.size),
        (1, ranks.size, 1),
        (ranks.size, 1, 1),
        Decomposition(shape[::-1], ranks).processes,
    }
    for processes, given in product(sorted(cuts), (faces, {})):
        boxes, found = Decomposition(shape[::-1], ranks, processes=processes), []
        axes = {"face_x": 0, "face_y": 1, "face_z": 2}
        mine = {key: part(value, boxes.box, shape, axes.get(key)) for key, value in given.items()}
        A = wl.GridPoisson(part(cells, boxes.box, shape), decomposition=boxes, device="cpu", **mine)
        for streams, threads in ((True, 1), (False, 1), (True, 2)):
            wl.set_threads(threads)
            hierarchy = make_hierarchy(A.stencil, wp.float64, bounded=True)
            hierarchy.mask_diagonal(
                A.stencil.d, A.layout.load(part(free, boxes.box, shape).astype(np.uint8), wp.uint8)
            )
            hierarchy.rebuild_changed()
            for field, values in (
                (hierarchy.finest.b, b),
                (hierarchy.finest.lower, -gaps[0]),
                (hierarchy.finest.upper, gaps[1]),
            ):
                field.assign(
                    A.layout.load(
                        part(np.where(free & (cells == wl.FLUID), values, 0.0), boxes.box, shape),
                        wp.float64,
                    )
                )
            with mock.patch.object(StencilLevel, "fuses", StencilLevel.fuses if streams else False):
                cycles = hierarchy.cycle, hierarchy.cycle, hierarchy.monotone_cycle, hierarchy.cycle
            for cycle in cycles:
                cycle.run()
                found.append(A.layout.unload(hierarchy.finest.x).numpy())
        wl.set_threads(1)
        for once, apart, together in zip(found[:4], found[4:8], found[8:], strict=True):
            assert once.tobytes() == together.tobytes(), processes
            assert np.abs(once - apart).max() <= 1e-13 * ranks.max(np.abs(apart).max()) > 0, (
                processes
            )
    halo_levels.GATHERED = gathered


def wrong_input(ranks):
    """Refuse wrong input on all ranks."""
    shape = (32, 18, 18)
    boxes = Decomposition((18, 18, 32), ranks)
    cells, b = (
        part(field, boxes.box, shape) for field in (scene(shape), rng.standard_normal(shape))
    )
    problem = wl.LCP(wl.GridPoisson(cells, decomposition=boxes, device="cpu"), b)
    for arguments, word in (
        ({"periodic": (True, False, False)}, "periodic"),
        ({"face_x": np.ones((3, 3, 3))}, "face_x"),
    ):
        try:
            wl.GridPoisson(cells, decomposition=boxes, device="cpu", **arguments)
            raise AssertionError(word)
        except ValueError as error:
            assert word in str(error), error
    if ranks.size > 1:
        try:  # on one rank alone
            wl.GridPoisson(
                cells if ranks.rank else cells[:, :-1], decomposition=boxes, device="cpu"
            )
            raise AssertionError("cells")
        except ValueError as error:
            assert "rank 0: cells has shape" in str(error), error
        try:
            wl.solve(problem, wl.ProjectedSOR())
            raise AssertionError("ProjectedSOR")
        except ValueError as error:
            assert "several ranks" in str(error)
        try:
            ranks.agree("the number", ranks.rank)
            raise AssertionError("agree")
        except ValueError as error:
            assert "the number on rank 1" in str(error)


def halos(ranks):
    """Compare ghost cells of every type with the owners' values."""
    for counts in ((13, 11, 9), (40, 30, 1)):
        for width in (1, 3):
            boxes = Decomposition(counts, ranks)
            halo = Halo(boxes, width)
            for dtype in (np.int8, np.int16, np.float32, np.float64):
                around = boxes.box.grown(width)
                ranges = (
                    np.arange(low, high)
                    for low, high in zip(around.low[::-1], around.high[::-1], strict=True)
                )
                z, y, x = np.meshgrid(*ranges, indexing="ij")
                inside = (
                    (x >= 0)
                    & (x < counts[0])
                    & (y >= 0)
                    & (y < counts[1])
                    & (z >= 0)
                    & (z < counts[2])
                )
                everyone = np.where(inside, ((z * 7 + y) * 5 + x) % 101, 0).astype(dtype)
                field, inner = np.zeros(halo.shape, dtype), (slice(width, -width),) * 3
                field[inner] = everyone[inner]
                halo.fill(field)
                assert (field == everyone).all()
    if ranks.size > 1:
        try:
            Halo(Decomposition((8, 8, 2 * ranks.size), ranks, processes=(1, 1, ranks.size)), 3)
            raise AssertionError("a halo wider than a box")
        except ValueError as error:
            assert "2 cells along z, but 3 ghost cells" in str(error)


def messages_in_tables(ranks):
    """Check sums over all ranks in tables of messages, and errors of MPI.

    Sums are in the order of the ranks. An error of MPI is raised when the table is done, and
    nothing is sent after it.
    """
    sums = np.array([0.1, 10.0**ranks.rank])
    run_table(OperationTable([ranks.sum_operation(sums)]))
    expected = ranks.sum(np.array([0.1, 10.0**ranks.rank]))
    assert sums.tobytes() == expected.tobytes()
    waiting.native[1] = 15
    try:
        run_table(OperationTable([ranks.sum_operation(np.ones(2))]))
        raise AssertionError("no error")
    except RuntimeError as error:
        assert "error 15" in str(error), error
    run_table(OperationTable([ranks.sum_operation(sums)]))
    assert waiting.native[0] % 2 == 0


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_ERROR
    everyone = Ranks.world()
    for check in (
        halos,
        messages_in_tables,
        shapes,
        other_cuts,
        closed_pools,
        memory_in_place,
        as_on_devices,
        legs,
        rounded_on_one_rank,
        low_rank,
        wrong_input,
    ):
        check(everyone)
    sys.stdout.write(f"rank {everyone.rank} of {everyone.size} is done\n")
