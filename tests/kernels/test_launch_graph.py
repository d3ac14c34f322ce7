"""Recorded launches.

Values that change between runs are read from memory; results are those of immediate launches.
"""

import functools
import math

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.fluids.pressure import COUNT
from warp_lcp.grid.cell_kernel import launch_list, list_kernel
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import SEGMENT, ActiveWindow, StaggeredGrid, Window
from warp_lcp.grid.transfer import accelerate, faces_to_particles, particles_to_faces
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels.launch_graph import (
    CommandBuffer,
    LaunchGraph,
    clear,
    copy,
    is_recording,
    recording,
)
from warp_lcp.kernels.recorded_arguments import Scalar, scaled
from warp_lcp.material.density_correction import CROWD
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

GRID = StaggeredGrid((29, 11, 7), 0.1, 3)


@pytest.fixture(params=[1, 3])
def threads(request):
    before = wl.get_threads()
    wl.set_threads(request.param)
    yield request.param
    wl.set_threads(before)


@pytest.fixture
def guarded(monkeypatch):
    """Record again in each run and compare.

    Direct launches and reads are refused while recording.
    """
    monkeypatch.setattr(LaunchGraph, "verify", True)

    def refuse(owner, name):
        plain = getattr(owner, name)

        @functools.wraps(plain)
        def guard(*arguments, **options):
            assert not is_recording() or options.get("record_cmd"), f"{name} while recording"
            return plain(*arguments, **options)

        monkeypatch.setattr(owner, name, guard)

    for name in ("launch", "copy"):
        refuse(wp, name)
    for name in ("zero_", "fill_", "numpy", "assign"):
        refuse(wp.array, name)


def window(rng: np.random.Generator, *, sparse: bool) -> Window:
    corners = np.sort(rng.integers(0, np.array(GRID.counts), (2, 3)), axis=0)
    box = GRID.window(corners[0] + 1, corners[1] + 1, grow=1)
    if not sparse:
        return box
    nz, ny, nx = GRID.shape
    return Window(box.low, box.high, box.device, rng.random((nz, ny, -(-nx // SEGMENT))) < 0.5)


@pytest.mark.parametrize("sparse", [False, True])
def test_a_recorded_window_is_that_of_the_run(threads, sparse):
    """Recorded window: that of the run.

    Cells, rows of sums and numbers of a graph that is recorded for one window are those of the
    window in which it runs.
    """
    rng = np.random.default_rng(11 + sparse)
    weight = wp.array(rng.uniform(0.0, 1.0, GRID.shape).astype(np.float32))
    kind = wp.array(rng.choice(np.array([AIR, FLUID, SOLID], dtype=np.int8), GRID.shape))
    field, other, change, active = GRID.field(), GRID.field(), Scalar(), ActiveWindow(GRID.domain)
    recorded, direct = WindowReduction(COUNT, GRID), WindowReduction(COUNT, GRID)

    def launch() -> None:
        active.clear(field)
        accelerate(active, [field], [weight], [change])
        recorded.launch(active, kind=kind)

    change.value = 1.0
    graph = LaunchGraph(GRID.device, launch)
    for _ in range(8):
        now = window(rng, sparse=sparse)
        active.move_to(now)
        change.value = float(rng.normal())
        field.fill_(7.0)
        other.fill_(7.0)
        graph.run(variant=sparse)
        now.clear(other)
        accelerate(now, [other], [weight], [change.value])
        direct.launch(now, kind=kind)
        np.testing.assert_array_equal(field.numpy(), other.numpy())
        assert recorded.read() == direct.read()


def test_a_recorded_list_is_that_of_the_run(threads, guarded):
    """Recorded list: that of the run.

    Passes over particles take as many as there are when they run, from the arrays that then hold
    them.
    """
    rng = np.random.default_rng(5)

    def points(count: int) -> np.ndarray:
        return rng.uniform(0.01, 0.99, (count, 3)) * GRID.extent

    particles = Particles(GRID, points(50), rng.normal(size=(50, 3)), affine=True)
    fields, weights = GRID.faces(), GRID.faces()

    def launch() -> None:
        p = particles
        particles_to_faces(GRID, p.position, p.velocity, p.affine, fields, weights)
        faces_to_particles(GRID, fields, p.position, p.velocity, p.affine)

    graph = LaunchGraph(GRID.device, launch)
    for step in range(8):
        if step % 3 == 1:  # beyond the capacity: arrays are replaced
            particles.append(points(9000 * step), rng.normal(size=(9000 * step, 3)))
        if step % 3 == 2:
            particles.remove(wp.array(rng.integers(0, 2, particles.count).astype(np.int32)))
            particles.sort()
        before = {name: array.numpy().copy() for name, array in particles.arrays().items()}
        graph.run()
        found = {name: array.numpy().copy() for name, array in particles.arrays().items()} | {
            "u": fields[0].numpy().copy()
        }
        for name, array in particles.arrays().items():
            array.assign(before[name])
        launch()
        expected = {name: array.numpy() for name, array in particles.arrays().items()} | {
            "u": fields[0].numpy()
        }
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)


def test_numbers_are_read_when_launches_run():
    """Numbers are read when launches run.

    A kernel reads a number in its own type, and products of it too; an immediate launch takes it as
    it is.
    """
    number = Scalar(3.0)
    third = scaled(number, 1.0 / 3.0)
    assert scaled(2.0, 0.5) == 1.0
    fields, weights = [GRID.field()], [wp.full(GRID.shape, 1.0, dtype=wp.float32)]
    graph = LaunchGraph(GRID.device, lambda: accelerate(GRID.everywhere, fields, weights, [third]))
    total = np.float32(0.0)
    for value in (3.0, 0.1, -7.25):
        number.value = value
        graph.run()
        total = total + np.float32(value * (1.0 / 3.0))
        assert fields[0].numpy()[1, 1, 1] == total
    accelerate(GRID.everywhere, fields, weights, [third])
    assert fields[0].numpy()[1, 1, 1] == total + np.float32(-7.25 * (1.0 / 3.0))


def test_copies_clears_and_graphs_within_graphs():
    a, b = wp.array(np.arange(5.0)), wp.zeros(5, dtype=wp.float64)
    inner = LaunchGraph(a.device, lambda: copy(b, a))

    def launch() -> None:
        inner.run()
        clear(a)

    graph = LaunchGraph(a.device, launch)
    for start in (1.0, 2.0):
        a.fill_(start)
        graph.run()
        assert b.numpy().tolist() == [start] * 5
        assert not a.numpy().any()
    program = CommandBuffer(a.device)
    with recording(program):
        inner.run()
    assert len(program) == 1


@list_kernel("tests.launch_graph")
def double_kernel(i, numbers: wp.array(dtype=wp.float32)):
    """Double each number of a list."""
    numbers[i] = 2.0 * numbers[i]


def test_a_list_that_is_launched_by_a_program_runs_with_the_program(threads):
    values = np.arange(1.0, 10_001.0, dtype=np.float32)
    numbers = wp.array(values, device=GRID.device)
    program = CommandBuffer(GRID.device)
    launch_list(double_kernel, len(values), [numbers], device=GRID.device, launch=program.launch)
    np.testing.assert_array_equal(numbers.numpy(), values)
    for times in (2.0, 4.0):
        program.run()
        np.testing.assert_array_equal(numbers.numpy(), times * values)


def test_variants_are_recorded_for_themselves():
    calls, a, b = [], wp.ones(3, dtype=wp.float32), wp.zeros(3, dtype=wp.float32)
    which = [False]

    def launch() -> None:
        calls.append(which[0])
        clear(a if which[0] else b)

    graph = LaunchGraph(a.device, launch)
    for which[0] in (False, False, True, False, True):
        graph.run(variant=which[0])
    assert calls == [False, True]
    graph.forget()
    graph.run(variant=True)
    assert calls == [False, True, True]


def test_a_recording_outlives_its_thread_pool():
    """Recording after a change of the thread pool.

    The number of threads changes and changes back: the recording is valid, the pool is another one.
    """
    before, a = wl.get_threads(), wp.ones(3, dtype=wp.float32)
    graph = LaunchGraph(a.device, lambda: clear(a))
    try:
        for threads in (1, 2, 1, 3, 1):
            wl.set_threads(threads)
            if threads == 1:
                a.fill_(1.0)
                graph.run()
                assert not a.numpy().any()
    finally:
        wl.set_threads(before)


def test_a_changed_recording_is_found(guarded):
    """Changed recording: `verify` finds a replaced array without a slot."""
    fields = [wp.zeros(3, dtype=wp.float32), wp.zeros(3, dtype=wp.float32)]
    graph = LaunchGraph(fields[0].device, lambda: clear(fields[0]))
    graph.run()
    graph.run()
    fields.reverse()
    with pytest.raises(AssertionError, match=r"operation 0: copy, copy before"):
        graph.run()


def pairwise(values: list[float]) -> float:
    """Return the sum as NumPy computes it.

    NumPy has 8 accumulators over up to 128 values, and adds halves beyond.
    """
    if len(values) < 8:
        total = -0.0
        for value in values:
            total += value
        return total
    if len(values) > 128:
        half = len(values) // 2 - len(values) // 2 % 8
        return pairwise(values[:half]) + pairwise(values[half:])
    sums, whole = values[:8], len(values) - len(values) % 8
    for start in range(8, whole, 8):
        sums = [s + v for s, v in zip(sums, values[start:], strict=False)]
    total = ((sums[0] + sums[1]) + (sums[2] + sums[3])) + (
        (sums[4] + sums[5]) + (sums[6] + sums[7])
    )
    for value in values[whole:]:
        total += value
    return total


@pytest.mark.parametrize(
    "counts", [(7, 5, 1), (9, 11, 37), (5, 130, 1), (6, 60, 150), (3, 260, 40)]
)
def test_rows_are_added_up_pairwise(counts):
    """Pairwise sums of rows.

    They have the bits of pairwise summation over the rows of the box in order, in parts that fit
    8192 values.
    """
    rng = np.random.default_rng(sum(counts))
    grid = StaggeredGrid(counts, 0.1, 2 if counts[2] == 1 else 3)
    host = {"base": np.full(grid.shape, AIR, dtype=np.int8)}
    host |= {
        name: rng.uniform(0.0, 2.0, grid.shape).astype(np.float32)
        for name in ("density", "capacity")
    }
    fields = {name: wp.array(values) for name, values in host.items()}
    tally, all_cells = WindowReduction(CROWD, grid), WindowReduction(CROWD, grid, grid.domain)
    for _ in range(4):
        corners = np.sort(rng.integers(1, np.array(counts) + 1, (2, 3)), axis=0)
        box = grid.window(corners[0], corners[1])
        for found, counted in ((tally, box), (all_cells, grid.domain)):
            found.launch(box, **fields, most=1.2)
            rows = box.rows[0] * box.rows[1]
            parts = found._partials.numpy()[: 2 * rows].reshape(2, *box.rows)
            inside = np.zeros((2, *grid.shape[:2]))
            inside[:, box.low[0] : box.high[0], box.low[1] : box.high[1]] = parts
            inside = inside[:, counted.low[0] : counted.high[0], counted.low[1] : counted.high[1]]
            planes, width = counted.rows
            fit = planes * width if planes == 1 or width == grid.shape[1] else 8192 // width * width
            for value, column in zip(found.read(), inside, strict=False):
                flat = column.ravel().tolist()
                expected = 0.0
                for start in range(0, len(flat), fit):
                    expected += pairwise(flat[start : start + fit])
                assert value == expected


SCENES = {
    "dam-break-2d": (16, {}),
    "floating-bodies-2d": (16, {}),
    "column-collapse-2d": (16, {}),
    "tap-and-drain": (24, {}),
    "inclined-layer": (16, {}),
}


@pytest.mark.parametrize("scene", SCENES)
def test_a_step_records_nothing_that_changes(scene, guarded):
    """Recorded launches of a step, unchanged from step to step."""
    resolution, _ = SCENES[scene]
    run = wl.Run(scene, resolution=resolution, device="cpu")
    simulation = next(iter(run)).simulation
    for _ in range(3):
        dt = simulation.stable_dt()
        assert math.isfinite(dt)
        simulation.step(min(dt, 0.01))
