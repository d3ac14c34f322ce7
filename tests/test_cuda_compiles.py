"""Compilation of every kernel for CUDA, without a GPU."""

import gc
import importlib
import itertools
import pkgutil
import re
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.extras.petsc_matrix import ENTER, LEAVE
from warp_lcp.fluids.pressure import pressure_passes
from warp_lcp.fluids.stokes_kernels import stokes_kernels
from warp_lcp.fluids.surface_tension_kernels import push_pass
from warp_lcp.fluids.viscosity_passes import viscous_passes
from warp_lcp.granular.bodies_kernels import body_kernels
from warp_lcp.granular.report_kernels import report_pass
from warp_lcp.granular.stress_kernels import stress_passes
from warp_lcp.granular.stress_methods import interleaved_passes
from warp_lcp.grid.advection import CENTERS, advect_pass, carry_pass, distance_pass
from warp_lcp.grid.domain_sides import wrap_kernel
from warp_lcp.grid.transfer import transfer_passes
from warp_lcp.kernels import Rows
from warp_lcp.kernels.header_text import sections
from warp_lcp.kernels.kernel_variant import KernelVariant
from warp_lcp.kernels.layout import Alignment
from warp_lcp.kernels.persistent_kernel import PersistentKernel
from warp_lcp.kernels.stencil_kernel import StencilKernel
from warp_lcp.kernels.vectors import CUDA_BLOCK
from warp_lcp.material.density_correction import displacement_pass
from warp_lcp.multigrid import CycleSettings, Hierarchy
from warp_lcp.multigrid.stencil_level import StencilLevel
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.subproblems.principal_system import principal_system

# Modules that have compiled for CUDA, with the hash of their sources.
# `python tests/test_cuda_compiles.py` compiles the others and writes it.
COMPILED = Path(__file__).with_name("compiled_for_cuda.txt")
# As GPUs cycle.
ONE_LAUNCH = [
    CycleSettings(one_launch_cpu=4096),
    CycleSettings(one_launch_cpu=4096, coarsest_cpu=8),
]
EVERY_SECOND = Alignment(1, either=True)  # as rows of an even number of cells begin
IN_BLOCKS = EVERY_SECOND, EVERY_SECOND
METHODS = [
    wl.MinimumMapNewton(),
    wl.MinimumMapNewton(precision="double"),
    wl.ProjectedMultigrid(),
    wl.ProjectedMultigrid(precision="double"),
    wl.ProjectedSOR(),
    *(wl.ProjectedMultigrid(precision=p, cycle=c) for p in ("mixed", "double") for c in ONE_LAUNCH),
]


def use_every_kernel(reals):
    """Instantiate on-demand kernels by solving small problems in every precision."""
    cells = np.ones((4, 4, 4), dtype=int)
    cells[-1] = wl.AIR
    face = np.full((4, 4, 5), 0.5)
    for dtype in reals:
        for faces in ({}, {"face_x": 2.0}, {"face_x": face}):
            problem = wl.LCP(
                wl.GridPoisson(cells, device="cpu", dtype=dtype, **faces), -np.ones(cells.shape)
            )
            for solver in METHODS:
                assert wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=1e-4))
            for joins in (True, False):  # as on CUDA, with small levels apart and together
                on_cuda = mock.patch.multiple(StencilLevel, fuses=False, joins_sweeps=joins)
                cycles = (CycleSettings(coarsest_cpu=8), *ONE_LAUNCH)
                with on_cuda:
                    for precision, cycle in itertools.product(("mixed", "double"), cycles):
                        method = wl.ProjectedMultigrid(precision=precision, cycle=cycle)
                        assert wl.solve(problem, method, stopping=wl.StoppingCriteria(rtol=1e-4))
        assert Hierarchy(
            problem.A.stencil, dtype, bounded=False, settings=ONE_LAUNCH[1]
        )._small.coarsen_kernel.kernel
    for real in (wp.float32, wp.float64):
        transfer_passes(real)
    wl.solve(
        wl.LCP(wl.DenseOperator(np.eye(3), device="cpu"), -np.ones(3)),
        wl.MinimumMapNewton(precision="single"),
    )


def use_sparse_kernels(reals):
    """Instantiate the kernels of sparse matrices, sums and shifted principal systems."""
    cells = np.ones((4, 4), dtype=int)
    T = scipy.sparse.diags_array([-1.0, 3.0, -1.5], offsets=[-1, 0, 1], shape=(100, 100)).tocsr()
    for dtype in reals:
        low = wl.LowRankOperator(np.full((4, 4, 1), 0.1), [1.0], device="cpu", dtype=dtype)
        grid = wl.GridPoisson(cells, device="cpu", dtype=dtype, shift=1.0)
        operators = [
            wl.SparseOperator(m, device="cpu", dtype=dtype) for m in (T, (T + T.T).tocsr())
        ]
        operators += [
            wl.SumOperator(grid, low),
            wl.SumOperator(low, wl.GridPoisson(cells, device="cpu", dtype=dtype)),
            grid,
        ]
        for A in operators:
            problem, x = (
                wl.LCP(A, -np.ones(A.shape)),
                wp.ones(A.shape, dtype=wp.float64, device="cpu"),
            )
            A.apply_transpose(x)
            for real in (wp.float32, wp.float64):
                system = principal_system(problem, real, bounded=True, shifted=True)
                system.restrict(
                    problem.layout.load(np.ones(A.shape), wp.uint8),
                    problem.layout.load(np.ones(A.shape), wp.float64),
                )
                system.r.assign(problem.layout.load(np.ones(A.shape), system.r.dtype))
                assert system.solve(1e-3 * system.norm(), 50)[1] < 1e-3 * np.sqrt(
                    problem.layout.size
                )
        for A in operators[:2]:
            A.relax(
                *(wp.ones(100, dtype=wp.float64, device="cpu") for _ in range(4)), 1.0, colored=True
            )


def use_sweeping_kernels(reals):
    """Instantiate the kernels of sweeps, small blocks and first-order methods."""
    T = scipy.sparse.diags_array([-1.0, 3.0, -1.0], offsets=[-1, 0, 1], shape=(30, 30)).tocsr()
    friction = wl.AffineBounds.friction([-1, 0], 0.5)
    for dtype in reals:
        dense = wl.LCP(wl.DenseOperator(T.toarray(), device="cpu", dtype=dtype), -np.ones(30))
        sparse = wl.LCP(wl.SparseOperator(T, device="cpu", dtype=dtype), -np.ones(30))
        grid = wl.LCP(
            wl.GridPoisson(np.array([[0, 1, 1, 1]]), device="cpu", dtype=dtype), -np.ones((1, 4))
        )
        blocks = [wl.BlockedGaussSeidel(blocks=size) for size in range(1, 7)]
        orders = [wl.ProjectedSOR(order="magnitude"), wl.ProjectedSOR(order="greedy")]
        first = [
            wl.ProjectedJacobi(),
            wl.NNCG(),
            wl.AcceleratedProjectedGradient(),
            wl.Staggering(),
            wl.SubspaceMinimization(),
        ]
        for solver in [*blocks, *orders, *first, wl.SubspaceMinimization(precision="double")]:
            assert wl.solve(dense, solver)
        for problem in (sparse, grid):
            for solver in first:
                assert wl.solve(problem, solver)
        for faces in ({}, {"face_x": 2.0}, {"face_x": np.ones((1, 5))}):
            A = wl.GridPoisson(np.array([[0, 1, 1, 1]]), device="cpu", dtype=dtype, **faces)
            for axis in wl.GridLines:
                assert wl.solve(wl.LCP(A, -np.ones((1, 4))), wl.BlockedGaussSeidel(blocks=axis))
        for solver in (wl.ProjectedSOR(), wl.SubspaceMinimization(sweeps=1)):
            A = wl.DenseOperator(np.array([[3.0, -0.5], [-0.5, 3.0]]), device="cpu", dtype=dtype)
            assert wl.solve(wl.LCP(A, np.array([-1.0, -2.0]), *friction), solver)


def use_gradient_projection_kernels(reals):
    """Instantiate the kernels of MPRGP on all operators."""
    T = scipy.sparse.diags_array([-1.0, 3.0, -1.0], offsets=[-1, 0, 1], shape=(100, 100)).tocsr()
    cells = np.array([[0, 1, 1, 1]])
    for dtype in reals:
        operators = [
            wl.DenseOperator(T.toarray(), device="cpu", dtype=dtype),
            wl.SparseOperator(T, device="cpu", dtype=dtype),
        ]
        for faces in ({}, {"face_x": 2.0}, {"face_x": np.ones((1, 5))}):
            operators.append(wl.GridPoisson(cells, device="cpu", dtype=dtype, **faces))
        for A in operators:
            for precision in ("mixed", "double"):
                assert wl.solve(wl.LCP(A, -np.ones(A.shape)), MPRGP(precision=precision))
                # Releases all unknowns.
                assert wl.solve(
                    wl.LCP(A, -np.ones(A.shape), 0.0),
                    MPRGP(precision=precision),
                    x0=np.zeros(A.shape),
                )


def use_newton_kernels(reals):
    """Instantiate the kernels of Newton-type methods on grids.

    And those of cold starts and scalings of sparse matrices.
    """
    T = scipy.sparse.diags_array([-1.0, 2.01, -1.0], offsets=[-1, 0, 1], shape=(1200, 1200)).tocsr()
    cells = np.ones((4, 4, 4), dtype=int)
    cells[-1] = wl.AIR
    for dtype in reals:
        operators = [wl.SparseOperator(T, device="cpu", dtype=dtype)]
        for faces in ({}, {"face_x": 2.0}, {"face_x": np.full((4, 4, 5), 0.5)}):
            operators.append(wl.GridPoisson(cells, device="cpu", dtype=dtype, **faces))
        for A in operators:
            problem = wl.LCP(
                A, np.where(np.arange(np.prod(A.shape)).reshape(A.shape) % 2, -1.0, 1.0)
            )
            for precision in ("mixed", "double"):
                for method in (wl.MinimumMapNewton, wl.FischerNewton, wl.InteriorPoint, wl.Penalty):
                    assert wl.solve(
                        problem,
                        method(precision=precision),
                        stopping=wl.StoppingCriteria(rtol=1e-4),
                    ), (A, method, precision)


@wp.func
def drift(j: int, i: int):
    return -1.0 - 0.1 * float(i)


def use_stencil_kernels(reals):
    """Instantiate the kernels of compact stencils.

    They are those of numbers, arrays and functions, of lines and aggregates, and of matrices.
    """
    nine = np.array([[-1.0, -1.0, -1.0], [-1.0, 9.0, -1.0], [-1.0, -1.0, -1.0]])
    cells, wind = (
        np.ones((12, 12), dtype=int),
        {(0, 0): 5.0, (0, 1): -0.5, (1, 0): -1.0, (-1, 0): -1.0},
    )
    for dtype in reals:
        given = [
            nine,
            {**wind, (0, -1): np.full(cells.shape, -2.0)},
            {**wind, (0, -1): drift, (0, 0): 9.0},
        ]
        for coefficients in given:
            A = wl.Stencil(cells, coefficients, outside=wl.AIR, device="cpu", dtype=dtype)
            A.apply_transpose(wp.ones(A.shape, dtype=wp.float64, device="cpu"))
            for method in (
                None,
                wl.BlockedGaussSeidel(),
                wl.ProjectedSOR(),
                wl.MinimumMapNewton(precision="double"),
            ):
                assert wl.solve(
                    wl.LCP(A, np.where(np.arange(144).reshape(12, 12) % 2, -1.0, 0.5)), method
                )
    T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(50, 50))
    matrix = scipy.sparse.kron(scipy.sparse.eye_array(50), T) + scipy.sparse.kron(
        T, scipy.sparse.eye_array(50)
    )
    assert wl.solve(wl.LCP(wl.SparseOperator(matrix, device="cpu"), -np.ones(2500))).grid == (
        50,
        50,
    )


def use_kernels_of_gradients(reals):
    """Instantiate the kernels of vector-Jacobian products.

    They are instantiated for every kind of bounds and diagonal.
    """
    cells, T = (
        np.array([[0, 1, 1, 1]]),
        scipy.sparse.diags_array([-1.0, 3.0, -1.0], offsets=[-1, 0, 1], shape=(30, 30)).tocsr(),
    )
    for dtype in reals:
        operators = [
            wl.SparseOperator(T, device="cpu", dtype=dtype),
            wl.GridPoisson(cells, device="cpu", dtype=dtype),
        ]
        operators.append(
            wl.GridPoisson(cells, device="cpu", dtype=dtype, face_x=np.ones((1, 5)), shift=0.1)
        )
        for A in operators:
            for lower in (
                0.0,
                np.zeros(A.shape),
                np.linspace(-1.0, 0.0, A.shape[-1]) * np.ones(A.shape),
            ):
                assert wl.vjp(wl.solve(wl.LCP(A, -np.ones(A.shape), lower)), np.ones(A.shape))
        A = wl.Stencil(
            np.ones((12, 12), dtype=int), {(0, 0): 3.0, (0, 1): -1.0}, device="cpu", dtype=dtype
        )
        assert wl.vjp(wl.solve(wl.LCP(A, -np.ones(A.shape))), np.ones(A.shape))


def use_coupled_kernels(reals):
    """Instantiate the kernels of grids with a low-rank term.

    It is heavy enough that the preconditioner is corrected for it.
    """
    cells = np.ones((4, 4, 4), dtype=int)
    cells[-1] = wl.AIR
    columns = np.zeros((4, 4, 4, 2))
    columns[1, 1:3, 1:3] = [[[1.0, 0.5], [-1.0, 0.5]], [[1.0, -0.5], [-1.0, 0.2]]]
    for dtype in reals:
        low = wl.LowRankOperator(columns, [100.0, 100.0], device="cpu", dtype=dtype)
        for faces in ({}, {"face_x": 2.0}, {"face_x": np.full((4, 4, 5), 0.5)}):
            A = wl.SumOperator(wl.GridPoisson(cells, device="cpu", dtype=dtype, **faces), low)
            for precision in ("mixed", "double"):
                for method in (wl.ProjectedMultigrid, wl.MinimumMapNewton):
                    problem = wl.LCP(A, np.linspace(-1.0, 0.5, 64).reshape(cells.shape))
                    assert wl.solve(
                        problem,
                        method(precision=precision),
                        stopping=wl.StoppingCriteria(rtol=1e-4),
                    )


def use_sand_kernels():
    """Instantiate the kernels of sand in 2-D and 3-D, with both yield sets."""
    for dimension in (2, 3):
        for rate, cut in itertools.product((False, True), (0, 1, 2)):
            report_pass(dimension, rate, cut)
        for box, rate in ((False, False), (True, False), (False, True)):
            interleaved_passes(dimension, box, rate, listed=True)
            for real in (wp.float32, wp.float64):
                body_kernels(dimension, real, box, rate)
                for cut in (0, 1, 2):
                    stress_passes(dimension, real, box=box, rate=rate, cut=cut)


def use_contact_kernels():
    down, none = np.eye(3)[None], np.zeros((1, 3, 3))
    ball = wl.FrictionalContact(
        [0], [1], down, none, b=[[-1.0, 3.0, 4.0]], friction=[0.5], bodies=1, device="cpu"
    )
    assert wl.solve(ball, wl.ProximalGaussSeidel())


def family(name):
    """Return the common name of a module's variants, and its number of kernels.

    The name is without types and switches.
    """
    from warp._src.context import user_modules

    package, module, *variant = name.split(".")
    # Its switches are in the module's name; the longest variant has walls that cut and a rate, or a
    # box.
    if package == "granular":
        module = re.sub("_(2d|3d|float32|float64|rate|cut)(?=_|$)", "", module)
    # The longest variant has all switches.
    if package == "fluids" and module.startswith(("pressure", "viscosity")):
        module = re.sub("_(2d|cut|ghost|moving)(?=_|$)", "", module)
    return (
        package,
        module,
        len(user_modules[name].kernels),
        *(re.match("[a-z]*", word)[0] for word in variant),
    )


def modules_of_every_kernel(reals):
    """Instantiate all kernels; return the names of their modules."""
    for found in pkgutil.walk_packages(wl.__path__, "warp_lcp."):
        if not found.name.startswith(("warp_lcp.benchmarks.", "warp_lcp.extras.newton.")):
            importlib.import_module(found.name)
    use_every_kernel(reals)
    for cut in (False, True):
        displacement_pass(cut)
        push_pass(cut)
    for endless in (0, 1, 4, 5):
        advect_pass(endless)
        distance_pass(endless)
    for variant in itertools.product((False, True), repeat=4):
        pressure_passes(*variant)
    for dimension, *walls in itertools.product((2, 3), *((False, True),) * 4):
        viscous_passes(dimension, *walls)
        viscous_passes(dimension, True, *walls[1:], thin=True, bodies=True)
    for cut, moving, ghost, varies, bounded in itertools.product((False, True), repeat=5):
        stokes_kernels(cut=cut, moving=moving, ghost=ghost, varies=varies, bounded=bounded)
    for axis in (0, 1, 2, CENTERS):
        carry_pass(axis)
    for dtype in (wp.int8, wp.uint8, wp.int32, wp.float32, wp.float64):
        wrap_kernel(dtype)
    for d_type, real in itertools.product(
        (wp.uint8, wp.float32, wp.float64), (wp.float32, wp.float64)
    ):
        field, vector = (
            wp.zeros(8, dtype=real, device="cpu"),
            wp.zeros(8, dtype=wp.float64, device="cpu"),
        )
        rows = Rows.flat(8, field.device).beside(Rows.flat(8, field.device), (1, 1, 1))
        fields = {
            "d": wp.zeros(8, dtype=d_type, device="cpu"),
            "x": field,
            "v": vector,
            "scale": 1.0,
        }
        ENTER.bind(rows, **fields)
        LEAVE.bind(rows, **fields, others=None)
    use_sparse_kernels(reals)
    use_sweeping_kernels(reals)
    use_gradient_projection_kernels(reals)
    use_kernels_of_gradients(reals)
    use_newton_kernels(reals)
    use_stencil_kernels(reals)
    use_coupled_kernels(reals)
    use_sand_kernels()
    use_contact_kernels()
    for form in [made for made in gc.get_objects() if isinstance(made, KernelVariant)]:
        assert form.kernel  # kernel of the pass alone, which the CPU launches in waves
        if form.by_quads:
            assert form.by_quads.kernel  # in place of it on CUDA
            assert form.with_quads(IN_BLOCKS).kernel  # and on large grids
    for sequence in [made for made in gc.get_objects() if isinstance(made, PersistentKernel)]:
        for clustered in (False, True):
            assert sequence.kernel_by_quads(clustered=clustered)  # as CUDA launches it
    from warp._src.context import user_modules

    return sorted(
        name
        for name, module in user_modules.items()
        if name.startswith(("warp_lcp", "fluids", "granular")) and module.kernels
    )


def kernels_not_taken():
    """Return the kernels of headers that no pass above has used."""
    interleaved_passes(2)  # for a CPU alone
    launched = {
        (made.header.resolve(), made.declared)
        for made in gc.get_objects()
        if isinstance(made, StencilKernel) and made.declared
    }
    return [
        f"{path}:{section.line}"
        for path in {header for header, _ in launched}
        for section in sections(path).values()
        if section.kind == "kernel" and (path, section.name) not in launched
    ]


def one_a_family(names):
    """Return the longest name of each family."""
    return list({family(name): name for name in sorted(names, key=len)}.values())


def source_hash(name):
    """Return the hash of a module, without parts for the CPU's compilation alone."""
    from warp._src.context import user_modules

    module = user_modules[name]
    for_cpus = {
        key: module.options.get(key) for key in ("cpu_compiler_flags", "extra_build_options")
    }
    module.options.update(dict.fromkeys(for_cpus))
    found = module.hash_module().hex()
    wp.set_module_options(for_cpus, module=name)
    module.mark_modified()
    return found


def lines_of(names):
    """Return a line for each module: name, hash of its source, Warp's version."""
    return sorted(f"{name} {source_hash(name)[:20]} {wp.__version__}" for name in names)


def threads_of(kernel):
    """Return the threads of a kernel's blocks."""
    bounds = kernel.options.get("launch_bounds", CUDA_BLOCK)
    return bounds[0] if isinstance(bounds, tuple) else bounds


def compile_for_cuda(name, archs, folder):
    """Compile a module for CUDA, with blocks as large as they are launched."""
    from warp._src.context import user_modules

    module = user_modules[name]
    bounds = {threads_of(kernel) for kernel in module.kernels.values()}
    module.options["block_dim"], *others = bounds
    assert not others, f"{name}: kernels of blocks of {bounds} threads"
    if any(kernel.options.get("cluster_dim", 1) > 1 for kernel in module.kernels.values()):
        archs = [90]  # others have no clusters
    wp.compile_aot_module(name, device=None, arch=archs, module_dir=folder, use_ptx=True)
    # passes of a launch read what others have written
    if name.startswith("warp_lcp.small_levels."):
        for made in Path(folder).glob("*.ptx"):
            assert "ld.global.nc" not in made.read_text(), name


@pytest.mark.parametrize(
    ("reals", "archs"),
    [
        ((wp.float64,), [80]),
        pytest.param((wp.float32, wp.float64), [80, 90], marks=pytest.mark.slow),
    ],
    ids=["one", "all"],
)
def test_kernels_compile_for_cuda(reals, archs, tmp_path, every_object):
    """Compilation for CUDA of one variant of each family of modules, or of all.

    Modules that have compiled unchanged are left out.
    """
    names = modules_of_every_kernel(reals)
    assert len(names) > 15
    assert not kernels_not_taken()
    if len(archs) == 1:
        compiled = set(COMPILED.read_text().splitlines())
        names = [line.split()[0] for line in lines_of(one_a_family(names)) if line not in compiled]
    # All modules take minutes, so each is compiled once while it is unchanged.
    known = Path(wp.config.kernel_cache_dir) / "compiled-for-cuda"
    known.mkdir(exist_ok=True)
    for name in names:
        mark = known / f"{name}-{source_hash(name)}-{'-'.join(map(str, archs))}"
        if mark.exists():
            continue
        try:
            compile_for_cuda(name, archs, tmp_path / name)
        except (RuntimeError, OSError) as error:
            pytest.fail(f"{name} does not compile: {error}")
        mark.touch()


if __name__ == "__main__":
    known = set(COMPILED.read_text().splitlines()) if COMPILED.exists() else set()
    lines = lines_of(one_a_family(modules_of_every_kernel((wp.float64,))))
    with tempfile.TemporaryDirectory() as folder:
        for line in lines:
            if line not in known:
                compile_for_cuda(line.split()[0], [80], Path(folder) / line.split()[0])
    COMPILED.write_text("\n".join(lines) + "\n")
