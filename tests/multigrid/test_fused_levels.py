"""All small levels in one launch against one launch per stage.

The inverse of the coarsest one is compared with dense algebra.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from multigrid.test_hierarchy import level_matrix, masked_hierarchy
from warp_lcp.kernels import Rows
from warp_lcp.kernels.persistent_kernel import CUDA_THREADS, THREADS
from warp_lcp.multigrid import CycleSettings, Hierarchy
from warp_lcp.multigrid.coarsest_kernels import coarsest_kernels
from warp_lcp.multigrid.fused_levels import FusedCoarseLevels, cells_of_one_launch

TOGETHER = {"one_launch_cpu": 4096, "one_launch_cuda": 4096}
APART = {"one_launch_cpu": 0, "one_launch_cuda": 0}
GRIDS = [((17, 12, 21), (False,) * 3), ((33, 40), (False,) * 3), ((8, 12, 10), (True, False, True))]
FACES = ["equal", "numbers", "arrays"]


def problem(shape, faces, seed=83):
    """Return cells, the free ones and keywords of their faces."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(3, shape, p=[0.1, 0.85, 0.05])
    arrays = rng.uniform(0.1, 1, (*shape[:-1], shape[-1] + 1))
    arrays[..., -1] = arrays[..., 0]
    return (
        cells,
        rng.random(shape) < 0.9,
        {"equal": {}, "numbers": {"face_x": 2.0}, "arrays": {"face_x": arrays}}[faces],
    )


def fill(hierarchy, cells, seed=89):
    """Set a right-hand side and bounds, and return the unknowns."""
    rng, finest = np.random.default_rng(seed), hierarchy.finest
    inside = np.pad(cells.reshape(finest.stencil.padding.counts) == wl.FLUID, 1).ravel()
    finest.b.assign(rng.standard_normal(inside.size) * inside)
    finest.lower.assign(-rng.uniform(0, 0.3, inside.size) * inside)
    finest.upper.assign(rng.uniform(0, 0.3, inside.size) * inside)
    return inside


def run_cycle(hierarchy, cells, projected):
    inside = fill(hierarchy, cells)
    (hierarchy.monotone_cycle if projected else hierarchy.cycle).run()
    return hierarchy.finest.x.numpy() * inside


@pytest.mark.parametrize(  # each pair compiles kernels; slow pairs differ from quick ones in a type
    ("faces", "real"),
    [
        *((faces, wp.float32) for faces in FACES),
        ("arrays", wp.float64),
        *(pytest.param(faces, wp.float64, marks=pytest.mark.slow) for faces in FACES[:2]),
    ],
)
@pytest.mark.parametrize(("shape", "periodic"), GRIDS)
def test_cycles_and_levels_are_those_of_single_launches(shape, periodic, faces, real, device):
    """Cycles and levels of a single launch against single launches.

    A missing stage, a wrong order or a wrong array changes the cycle by far more than rounding.
    """
    cells, free, keywords = problem(shape, faces)
    apart = masked_hierarchy(
        cells, free, periodic, device, CycleSettings(**APART), real, True, **keywords
    )[1]
    together = masked_hierarchy(
        cells, free, periodic, device, CycleSettings(**TOGETHER), real, True, **keywords
    )[1]
    for one, other in zip(apart.levels, together.levels, strict=True):
        np.testing.assert_array_equal(one.stencil.d.numpy(), other.stencil.d.numpy())
    eps = np.finfo(wp.dtype_to_numpy(real)).eps
    for projected in (False, True):
        expected = run_cycle(apart, cells, projected)
        np.testing.assert_allclose(
            run_cycle(together, cells, projected),
            expected,
            rtol=0,
            atol=20 * eps * np.abs(expected).max(),
        )
        assert np.abs(expected).max() > 0.1
        # On CUDA, the last launches of the descent, the visits and the first of the ascent have
        # become one.
        program = "monotone_cycle" if projected else "cycle"
        assert device == "cpu" or len(getattr(together, program)) < len(getattr(apart, program))


@pytest.mark.parametrize("projected", [False, True])
@pytest.mark.parametrize(("shape", "periodic"), GRIDS)
def test_threads_of_a_block_share_a_stage_in_any_number(shape, periodic, projected):
    """Stage shared by any number of threads of a block.

    As on a GPU, a cell at a time by strided threads, but with a launch per stage in place of the
    barriers. A cell that two threads or none take, and a stage whose threads read what others of it
    write, give another result.
    """
    cells, free, keywords = problem(shape, "arrays")
    hierarchy = masked_hierarchy(
        cells, free, periodic, "cpu", CycleSettings(**TOGETHER), wp.float64, True, **keywords
    )[1]
    rows, first = hierarchy._small, hierarchy._small.levels[0]
    inverse = hierarchy._dense.inverse.numpy().copy()
    rng = np.random.default_rng(101)
    inside = first.stencil.d.numpy() != 0
    first.b.assign(rng.standard_normal(inside.size) * inside)
    first.lower.assign(-rng.uniform(0, 0.3, inside.size) * inside)
    first.upper.assign(rng.uniform(0, 0.3, inside.size) * inside)
    for stage in rows.solve(2, projected=projected, from_zero=True):
        stage.launch(wp.launch)
    expected = first.x.numpy() * inside
    assert np.abs(expected).max() > 0.1

    made = [
        a.numpy() for level in rows.levels[1:] for a in (level.stencil.d, *level.stencil.weights)
    ]
    for level in rows.levels:
        L = level.stencil.rows.single
        level._bound.clear()
        counts = level.stencil.padding.counts
        level.stencil.__dict__["rows"] = Rows.strided(
            level.stencil.d.size, first.x.device, (L.base, L.s1, L.s2), counts, cells=1
        )
    kernels, s, m = (
        coarsest_kernels(*rows.levels[-1].form[:3]),
        rows.levels[-1].stencil,
        len(inverse),
    )
    inputs = [
        s.struct,
        s.rows.single,
        wp.vec3i(*map(int, s.periodic)),
        wp.float64(1e-13),
        1,
        hierarchy._dense.matrix,
        hierarchy._dense.inverse,
    ]
    wp.launch(kernels.invert, 1, inputs, device="cpu")
    np.testing.assert_allclose(hierarchy._dense.inverse.numpy(), inverse, rtol=1e-12)
    dense = hierarchy._dense
    dense.product = dense.product._replace(rows=Rows.by_turns(m, first.x.device, m))
    small = FusedCoarseLevels(rows.levels, dense.solve)
    (cycles,) = small.solve(2, projected=projected, from_zero=True)
    for threads in (1, 7, 64):
        for level in rows.levels:
            level.x.zero_()
            level.t.zero_()
            level.changed.fill_(1)
            for w in (level.stencil.d, *level.stencil.weights) if level is not first else ():
                w.zero_()
        for sequence in (small.coarsen_kernel, cycles):
            for i in range(len(sequence.tables.order)):
                wp.launch(
                    sequence.kernel, threads, [sequence.tables, i, i + 1, threads], device="cpu"
                )
        found = [
            a.numpy()
            for level in rows.levels[1:]
            for a in (level.stencil.d, *level.stencil.weights)
        ]
        for a, expected_field in zip(found, made, strict=True):
            np.testing.assert_array_equal(a, expected_field)
        np.testing.assert_allclose(first.x.numpy() * inside, expected, rtol=0, atol=1e-13)


def test_clusters_of_blocks_take_larger_levels():
    def cells(arch, **settings):
        names = dict.fromkeys(("is_cuda", "is_cuda_like"), True)
        names |= dict.fromkeys(("is_cpu", "is_cpu_like"), False)
        device = SimpleNamespace(arch=arch, **names)
        return cells_of_one_launch(CycleSettings(**settings), device)

    assert (cells(89), cells(90), cells(120)) == (512, 4096, 4096)
    assert cells(90, one_launch_cuda=0) == 0
    assert cells(90, one_launch_cluster=0) == 512


@pytest.mark.every_case
@pytest.mark.parametrize("faces", FACES)
@pytest.mark.parametrize(
    ("shape", "periodic"),
    [((3, 4, 5), (False,) * 3), ((2, 3, 2), (True, True, True)), ((7, 9), (True, False))],
)
def test_the_coarsest_level_is_inverted(shape, periodic, faces, device):
    """Inverse of the coarsest level.

    Its matrix comes from its own product, column by column. Two faces join the cells of a periodic
    axis of two.
    """
    cells, free, keywords = problem(shape, faces)
    _, hierarchy = masked_hierarchy(
        cells, free, periodic, device, CycleSettings(**TOGETHER), **keywords
    )
    assert len(hierarchy.levels) == 1
    matrix, inverse = level_matrix(hierarchy.finest.stencil), hierarchy._dense.inverse.numpy()
    unknown = np.diag(matrix) > 0
    assert 0 < unknown.sum() < cells.size
    np.testing.assert_allclose(
        (inverse @ matrix)[np.ix_(unknown, unknown)], np.eye(unknown.sum()), atol=1e-12
    )
    assert not inverse[~unknown].any()
    assert not inverse[:, ~unknown].any()


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_a_singular_coarsest_level_is_pinned(real, device):
    """Singular coarsest level, pinned.

    In a closed domain one unknown of each component is 0, and the rest is a generalized inverse.
    """
    cells = np.full((4, 4, 4), wl.FLUID)
    cells[:, :, 2] = wl.SOLID  # two components
    _, hierarchy = masked_hierarchy(
        cells, np.ones(cells.shape), (False,) * 3, device, CycleSettings(**TOGETHER), real
    )
    matrix, inverse = level_matrix(hierarchy.finest.stencil, real), hierarchy._dense.inverse.numpy()
    assert np.linalg.matrix_rank(inverse) == (cells == wl.FLUID).sum() - 2
    np.testing.assert_allclose(matrix @ inverse @ matrix, matrix, atol=1e-11)


@pytest.mark.parametrize("method", [wl.MinimumMapNewton, wl.ProjectedMultigrid])
def test_solves_take_the_same_iterations(method, device):
    cells, _, _ = problem((20, 24, 18), "equal")
    b = np.random.default_rng(97).standard_normal(cells.shape)
    results = []
    for settings in (APART, TOGETHER):
        A = wl.GridPoisson(cells, device=device)
        results.append(wl.solve(wl.LCP(A, b), method(cycle=CycleSettings(**settings))))
    one, other = results
    assert one
    assert other
    assert (one.iterations, one.linear_iterations) == (other.iterations, other.linear_iterations)
    np.testing.assert_allclose(
        [r.residual for r in other.history], [r.residual for r in one.history], rtol=1e-3
    )


def test_levels_follow_when_the_cells_change(device):
    """Levels after a change of the cells.

    The tables on the device hold addresses: rows, spans and weights that change in place take
    effect.
    """
    cells = np.full((10, 12, 48), wl.AIR)
    cells[:, :6, :10] = wl.FLUID
    moved = np.full(cells.shape, wl.AIR)
    moved[:5, :, 30:] = wl.FLUID
    A = wl.GridPoisson(cells, device=device, dtype=wp.float64)
    both = [
        Hierarchy(A.stencil, wp.float64, bounded=True, settings=CycleSettings(**s))
        for s in (APART, TOGETHER)
    ]
    for now in (cells, moved):
        A.update(wp.array(now.astype(np.int8), dtype=wp.int8, device=device))
        found = []
        for hierarchy in both:
            hierarchy.refresh()
            hierarchy.mask_diagonal(
                A.stencil.d, A.layout.load((now == wl.FLUID).astype(np.uint8), wp.uint8)
            )
            hierarchy.rebuild()
            found.append([run_cycle(hierarchy, now, projected) for projected in (False, True)])
        for expected, other in zip(*found, strict=True):
            np.testing.assert_allclose(other, expected, rtol=0, atol=1e-13)
            assert np.abs(expected).max() > 0.1


@pytest.mark.cpu_form("compiles for GPUs, emulated or not")
@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_the_gpu_waits_after_every_stage_and_reads_what_others_wrote(real, tmp_path):
    """Barriers of the GPU after every stage, and loads that bypass the cache.

    Barriers are in the GPU's source only. Loads must see a block's own writes.
    """
    cells, free, keywords = problem((8, 12, 10), "arrays")
    hierarchy = masked_hierarchy(
        cells, free, (True, False, True), "cpu", CycleSettings(**TOGETHER), real, True, **keywords
    )[1]
    modules = {
        hierarchy._small.solve(1, projected=projected, from_zero=True)[0].kernel.module.name: 1
        for projected in (False, True)
    }
    modules[hierarchy._small.coarsen_kernel.kernel.module.name] = 1
    # Assembled, eliminated forward and backward.
    modules[coarsest_kernels(True, real, real).invert.module.name] = 3
    for module, barriers in modules.items():
        (path,) = wp.compile_aot_module(
            module, device=None, arch=[80], module_dir=tmp_path, use_ptx=True
        )
        (text,) = path.read_text().split(".visible .entry")[1:]
        assert text.count("bar.sync") == barriers, module
        assert "ld.global.nc" not in text
        # Otherwise too few registers may be left for such a block.
        block = CUDA_THREADS if "coarsest" in module else THREADS
        assert f".maxntid {block}" in text


def test_levels_of_at_most_so_many_cells_are_taken(device):
    A = wl.GridPoisson(np.full((32, 32, 32), wl.FLUID), device=device)
    for cells in (0, 64, 512, 4096):
        hierarchy = Hierarchy(
            A.stencil,
            wp.float32,
            bounded=False,
            settings=CycleSettings(one_launch_cpu=cells, one_launch_cuda=cells),
        )
        counts = [
            np.prod(level.stencil.padding.counts)
            for level in hierarchy.levels[hierarchy._first_small :]
        ]
        assert counts == [n for n in (4096, 512, 64) if n <= cells]
