"""Thread pool: the bits of one thread, whatever interrupts, forks or leaves.

The results without a pool are the same.
"""

import math
import os
import shutil
import subprocess
import sys
import textwrap
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.gallery import splash
from warp_lcp.kernels import FusedKernel, Rows, StencilKernel
from warp_lcp.kernels import fused_kernel as wave
from warp_lcp.kernels import thread_pool as team
from warp_lcp.kernels.fields import Padding
from warp_lcp.kernels.header_text import HEADERS
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.vectors import ADD, Reduction, rows_of

CPU = wp.get_device("cpu")
COUNTS = (1, 2, 3, 7)

pytestmark = pytest.mark.cpu_form("the team is the CPU's")


@pytest.fixture(autouse=True)
def threads_as_before():
    """Restore the number of threads."""
    before = wl.get_threads()
    yield
    wl.set_threads(before)


@pytest.fixture
def small_pieces(monkeypatch):
    """Split small work, too."""
    monkeypatch.setattr(team, "CELLS", 64)
    monkeypatch.setattr("warp_lcp.kernels.fused_kernel.CELLS", 64)
    monkeypatch.setattr("warp_lcp.kernels.launch_graph.CELLS", 64)


def solved(n: int, bounds: str, method: object = None) -> tuple[bytes, int]:
    scene = splash(n)
    problem = wl.LCP(wl.GridPoisson(scene.cells, device="cpu"), scene.b, scene.lower(bounds))
    result = wl.solve(problem, method, stopping=wl.StoppingCriteria(rtol=1e-6))
    return result.x.numpy().tobytes(), result.iterations


@pytest.mark.parametrize("bounds", ["linear", "everywhere"])
@pytest.mark.parametrize(
    "method", [wl.ProjectedMultigrid(), wl.InteriorPoint(), wl.MPRGP(), wl.MinimumMapNewton()]
)
def test_bits_do_not_depend_on_the_number_of_threads(method, bounds, small_pieces):
    found = []
    for count in COUNTS:
        wl.set_threads(count)
        found.append(solved(24, bounds, method))
    assert found == found[:1] * len(COUNTS)


def passes(folder) -> tuple[StencilKernel, StencilKernel, StencilKernel]:
    """Return passes that a wave must keep in order.

    x moves in place; t is the neighbors of x then, in a ring of planes, and x those of t.
    """
    (folder / "move.h").write_text("for (int k = 0; k < n; ++k) x[k] += 1 + P.k;\n")
    (folder / "into.h").write_text(
        "for (int k = 0; k < n; ++k) t[k] = x[k] + x[k + zm] - 2*x[k + zp];\n"
    )
    (folder / "out.h").write_text(
        "T s = 0;\nfor (int k = 0; k < n; ++k) { x[k] = t[k] + 3*t[k + down] - t[k + up]; s += "
        "x[k]; }\n"
    )
    f32 = wp.float32
    move = StencilKernel("test_team.move", folder / "move.h", f32, writes={"x": f32})
    into = StencilKernel(
        "test_team.into", folder / "into.h", f32, reads={"x": f32}, writes={"t": f32}, ring=("t",)
    )
    return (
        move,
        into,
        StencilKernel(
            "test_team.out",
            folder / "out.h",
            f32,
            reads={"t": f32},
            writes={"x": f32},
            ring=("t",),
            sums=("s",),
        ),
    )


@pytest.mark.parametrize("planes", [3, 22, 23, 47, 64])
def test_slabs_of_a_fused_kernel_are_one_stream(planes, tmp_path, small_pieces):
    """Slabs of a wave as one stream.

    Whole numbers, so that a missed, repeated or early plane shows.
    """
    move, into, out = passes(tmp_path)
    padding = Padding((planes, 5, 9))
    rows = Rows.of(padding, CPU)
    host = np.zeros(padding.shape, dtype=np.float32)
    host[1:-1, 1:-1, 1:-1] = np.random.default_rng(planes).integers(-3, 4, (planes, 5, 9))
    expected = host.copy()
    expected[1:-1, 1:-1, 1:-1] += np.arange(1, planes + 1)[:, None, None]
    t = np.zeros_like(host)
    t[1:-1, 1:-1, 1:-1] = (expected[1:-1] + expected[:-2] - 2 * expected[2:])[:, 1:-1, 1:-1]
    expected[1:-1, 1:-1, 1:-1] = (t[1:-1] + 3 * t[:-2] - t[2:])[:, 1:-1, 1:-1]
    for count in COUNTS:
        wl.set_threads(count)
        x, ring = (
            wp.array(a, dtype=wp.float32, device=CPU) for a in (host.ravel(), 0 * host.ravel())
        )
        scalars = wp.zeros(1, dtype=wp.float64, device=CPU)
        sums, program = Reduction(rows.size, CPU, scalars, threads=rows.places), CommandBuffer(CPU)
        stages = [
            move.bind(rows, x=x),
            into.bind(rows, x=x, t=ring),
            out.bind(rows, t=ring, x=x, out=sums.partials),
        ]
        FusedKernel("test_team.wave", (move, 0), (into, 1), (out, 2)).launch(
            *stages, launch=program.launch
        )
        sums.add_up(0, launch=program.launch)
        program.run()
        np.testing.assert_array_equal(x.numpy().reshape(host.shape)[1:-1], expected[1:-1])
        assert scalars.numpy()[0] == expected[1:-1].sum(dtype=np.float64)


@pytest.mark.every_case
@pytest.mark.parametrize("threads", [2, 3, 8, 64])
@pytest.mark.parametrize("planes", [20, 22, 47, 100, 128, 129, 256, 700])
def test_slabs_fill_their_threads(planes, threads):
    slabs, each = wave.slabs_of(planes, 10, threads)
    last = planes - (slabs - 1) * each
    assert slabs >= 2
    assert each % 2 == 0
    assert last >= each >= 10
    share = -(-slabs // threads) * each + last - each
    assert share <= 1.3 * max(planes / threads, 14) or planes < 128


@pytest.mark.every_case
@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize(
    ("tasks", "cells"),
    [(1, 1), (9, 30000), (68, 65536), (500, 98), (1850, 98), (10**6, 1), (10**6, 20)],
)
def test_pieces_of_a_pass_are_as_many_for_each_thread(tasks, cells, threads):
    """Pieces of a pass, equal for each thread.

    They cover all tasks, none is small, and the thread with the most has hardly more than its
    share.
    """
    wl.set_threads(threads)
    stage = team.OperationKind.__new__(team.OperationKind)
    stage.tasks, stage.words = tasks, (0,) * 10
    count, each = (cut := team.ranges(stage, cells)).chunks, cut.words[3]
    assert (count - 1) * each < tasks <= count * each
    assert count == 1 or each * cells >= team.CELLS
    assert -(-count // threads) * each < tasks / threads + each + threads
    if tasks * cells >= threads * team.CELLS and tasks > 100 * threads:
        assert count % threads == 0
    assert team.ranges(stage, cells, ordered=True).chunks == 1


def test_two_python_threads_solve_at_once():
    wl.set_threads(2)
    expected = {n: solved(n, "everywhere") for n in (20, 28)}
    wrong = []

    def work(n: int) -> None:
        wrong.extend(n for _ in range(12) if solved(n, "everywhere") != expected[n])

    workers = [threading.Thread(target=work, args=(n,)) for n in expected for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not wrong


@pytest.mark.slow
def test_many_python_threads_for_ten_minutes():
    wl.set_threads(3)
    sizes = (12, 20, 28, 40)
    expected, wrong, until = {n: solved(n, "everywhere") for n in sizes}, [], time.monotonic() + 600

    def work(seed: int) -> None:
        rng = np.random.default_rng(seed)
        while time.monotonic() < until and not wrong:
            n = int(rng.choice(sizes))
            wrong.extend([n] * (solved(n, "everywhere") != expected[n]))

    workers = [threading.Thread(target=work, args=(seed,)) for seed in range(5)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not wrong


def run_python(code: str, **variables: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "WARP_LCP_THREADS": "2", **variables}
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return subprocess.run(
        command, check=False, capture_output=True, text=True, env=environment, timeout=300
    )


SOLVE = """
import os, sys, time, hashlib
import warp_lcp as wl
from warp_lcp.gallery import splash
scene = splash(48)
problem = wl.LCP(wl.GridPoisson(scene.cells, device="cpu"), scene.b, scene.lower("everywhere"))
def digest(): return hashlib.md5(wl.solve(problem).x.numpy().tobytes()).hexdigest()
first = digest()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_child_has_its_own_thread_pool():
    """Thread pool of a forked child; both interpreters exit with running threads."""
    done = run_python(
        SOLVE
        + """
child = os.fork()
if child == 0:
    os._exit(0 if digest() == first else 3)
assert digest() == first
print(os.waitpid(child, 0)[1], wl.get_threads())
"""
    )
    assert (done.returncode, done.stdout.strip()) == (0, "0 2"), done.stderr


def test_an_interruption_is_heard_between_pieces():
    """Interruption between pieces.

    A table that would take minutes ends after Ctrl-C before it is complete, and the next solve is
    right.
    """
    done = run_python(
        SOLVE
        + """
import signal, threading
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.vectors import ADD, rows_of
import warp as wp
x, one = wp.zeros(1 << 22, dtype=wp.float32, device="cpu"), \
wp.full(1 << 22, 1.0, dtype=wp.float32, device="cpu")
program = CommandBuffer(x.device)
for _ in range(100_000):
    ADD.bind(rows_of(x), z=one, x=x).launch(program.launch) if _ == 0 \
else program.record(program._commands[0])
def interrupt():
    while x.numpy()[-1] < 2.0:  # launches that are done
        time.sleep(0.01)
    signal.raise_signal(signal.SIGINT)
threading.Thread(target=interrupt, daemon=True).start()
try:
    program.run()
except KeyboardInterrupt:
    print(2.0 <= x.numpy().max() < 50_000.0, digest() == first)
"""
    )
    assert done.stdout.strip() == "True True", done.stderr


@pytest.mark.parametrize("count", [0, -1, 1025, 1.5, "many"])
def test_wrong_numbers_of_threads(count, monkeypatch):
    with pytest.raises(
        ValueError, match=rf"count: {count!r}: expected a number of threads from 1 to 1024"
    ):
        wl.set_threads(count)
    if not isinstance(count, float):
        monkeypatch.setenv("WARP_LCP_THREADS", str(count))
        monkeypatch.setattr(team.STATE, "threads", None)  # as at the start
        with pytest.raises(
            ValueError,
            match=f"WARP_LCP_THREADS: '{count}': expected a number of threads from 1 to 1024",
        ):
            wl.get_threads()


def test_ranks_share_the_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(12)), raising=False)
    assert team.available_threads() == 12
    monkeypatch.setenv("OMPI_COMM_WORLD_LOCAL_SIZE", "4")
    assert team.available_threads() == 3
    monkeypatch.setenv("OMPI_COMM_WORLD_LOCAL_SIZE", "40")
    assert team.available_threads() == 1


def test_another_warp_means_one_thread_and_a_notice(monkeypatch):
    expected = solved(16, "everywhere")
    monkeypatch.setattr(team.STATE, "team", None)
    monkeypatch.setattr(team, "_entry", team._entry.__wrapped__)
    monkeypatch.setattr(team, "arguments_of", lambda launch: launch.parameters)
    with pytest.warns(
        UserWarning, match=r"one CPU thread: Warp \S+ records launches in an unknown format"
    ):
        assert solved(16, "everywhere") == expected


def test_a_table_keeps_no_arrays_once_it_is_gone():
    wl.set_threads(2)
    x = wp.zeros(1 << 20, dtype=wp.float32, device=CPU)
    kept = weakref.ref(x)
    ADD.bind(rows_of(x), z=x, x=x).launch()
    del x
    assert kept() is None


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_threads_have_no_data_races(tmp_path):
    """Races of threads, by ThreadSanitizer.

    It finds none in the pool, and finds the race of slabs without gaps between them.
    """
    source, program = Path(__file__).parent / "native" / "team.cpp", tmp_path / "team"
    command = ["g++", "-std=c++17", "-O1", "-g", "-fsanitize=thread", "-pthread", f"-I{HEADERS}"]
    built = subprocess.run(
        [*command, str(source), "-o", str(program)], check=False, capture_output=True, text=True
    )
    if "tsan" in built.stderr:
        pytest.skip("this compiler has no ThreadSanitizer")
    assert built.returncode == 0, built.stderr

    def run(rounds, gap):
        return subprocess.run(
            [str(program), str(rounds), str(gap)],
            check=False,
            capture_output=True,
            text=True,
            timeout=300,
        )

    done = run(1500, 1)
    if "unexpected memory mapping" in done.stderr:
        pytest.skip("ThreadSanitizer cannot run here")
    assert done.returncode == 0 and "data race" not in done.stderr, done.stderr
    assert "data race" in run(200, 0).stderr


@wp.struct
class MixedStruct:
    """Struct of several sizes, with a gap between members."""

    flag: wp.bool
    values: wp.array(dtype=wp.float64)
    place: wp.vec3i
    weight: wp.float64


@wp.struct
class SmallStruct:
    """Struct of four-byte members, aligned accordingly."""

    count: int
    weight: float
    place: wp.vec3i


@wp.kernel(enable_backward=False, module="tests.kernels.packing")
def packing_kernel(
    flag: wp.bool,
    a: wp.array(dtype=wp.float32),
    n: int,
    small: SmallStruct,
    b: wp.array3d(dtype=wp.uint8),
    x: wp.float64,
    place: wp.vec3i,
    y: float,
    many: wp.int64,
    m: MixedStruct,
    point: wp.vec2d,
    turn: wp.mat22,
    c: wp.array2d(dtype=wp.vec2i),
    last: bool,
):
    """Set a[n] = y, with arguments of all kinds."""
    a[n] = y


def drawn_arguments(rng):
    """Return arguments of `packing_kernel`.

    They are arrays, some of them strided or empty, vectors, a struct, and numbers.
    """
    m, small, sizes = MixedStruct(), SmallStruct(), rng.integers(0, 6, 7)
    small.count, small.weight, small.place = (
        int(rng.integers(9)),
        rng.standard_normal(),
        wp.vec3i(*map(int, rng.integers(-9, 9, 3))),
    )
    m.flag, m.weight, m.place = (
        bool(rng.integers(2)),
        rng.standard_normal(),
        wp.vec3i(*map(int, rng.integers(-9, 9, 3))),
    )
    m.values = wp.zeros(int(sizes[0]), dtype=wp.float64, device=CPU)
    a = wp.zeros(2 * int(sizes[1]) + 8, dtype=wp.float32, device=CPU)[:: int(rng.integers(1, 3))]
    b = wp.zeros(tuple(map(int, sizes[2:5])), dtype=wp.uint8, device=CPU)
    c = wp.zeros(tuple(map(int, sizes[5:7])), dtype=wp.vec2i, device=CPU)
    point, turn = wp.vec2d(*rng.standard_normal(2)), wp.mat22(*rng.standard_normal(4))
    y = rng.choice([0.1, -0.0, math.inf, 1e-46, 1e39, 3.0000001])
    number = int(rng.integers(-(1 << 62), 1 << 62))
    flag, last = bool(rng.integers(2)), bool(rng.integers(2))
    return [
        flag,
        a,
        int(rng.integers(-9, 4)),
        small,
        b,
        rng.standard_normal(),
        m.place,
        float(y),
        number,
        m,
        point,
        turn,
        c,
        last,
    ]


def test_arguments_are_packed_as_warp_packs_them():
    """Packed arguments against Warp's.

    Arguments of all kinds that the pool packs itself; all others are left to Warp, which converts
    or refuses them.
    """
    signature = team.signature_of(packing_kernel)
    for seed in range(50):
        inputs = drawn_arguments(np.random.default_rng(seed))
        recorded = wp.launch(packing_kernel, 1, inputs, device=CPU, record_cmd=True)
        assert signature.pack(inputs) == bytes(team.arguments_of(recorded))
    others = {
        1: inputs[4],
        2: 1 << 31,
        3: MixedStruct(),
        4: inputs[1],
        6: (1, 2, 3),
        9: wp.vec3i(),
        10: wp.vec2f(),
        12: None,
    }
    for place, other in others.items():
        assert signature.pack([*inputs[:place], other, *inputs[place + 1 :]]) is None, (
            f"argument {place}"
        )
