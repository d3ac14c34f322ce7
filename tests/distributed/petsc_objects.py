"""Program for ranks: the grid operator and its cycle as PETSc objects.

Usage: petsc_objects.py CHECK... with names of functions here. Fails by an assertion.
"""

import gc
import sys

import numpy as np
import scipy.sparse.linalg
import warp as wp
from oracle_problems import small
from petsc_oracles import level_matrix, shared_problem, solve_ours, whole_field

import warp_lcp as wl
from warp_lcp.distributed.launch import petsc
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.extras.petsc_matrix import PetscGrid
from warp_lcp.multigrid.cycle_settings import CycleSettings


def on_all_cells(problem, free):
    """Return the matrix on all cells from the definition.

    It is A on the free cells and the identity on the others.
    """
    A = problem.matrix().tocoo()
    cells, mask = np.flatnonzero(problem.fluid), free.ravel()
    rows, columns = cells[A.coords[0]], cells[A.coords[1]]
    kept, held = mask[rows] & mask[columns], np.flatnonzero(~mask)
    values = np.concatenate([A.data[kept], np.ones(held.size)])
    places = np.concatenate([rows[kept], held]), np.concatenate([columns[kept], held])
    return scipy.sparse.csc_array((values, places), shape=(mask.size,) * 2)


def random_vector(grid, boxes, shape, seed):
    """Return a random field of the whole grid, and its vector."""
    field = np.random.default_rng(seed).standard_normal(shape)
    return field, grid.vector(field.reshape(boxes.counts[::-1])[boxes.box.slices])


def products():
    """Compare products and diagonals on all unknowns and on a free set.

    They have unit coefficients and others, in 3-D and 2-D.
    """
    for name, dtype, accuracy in (
        ("brick", wp.float64, 1e-14),
        ("brick", wp.float32, 1e-6),
        ("plane", wp.float64, 1e-14),
    ):
        problem = small(name, "walls")
        boxes, lcp = shared_problem(problem, Ranks.world(), dtype=dtype)
        grid, shape = PetscGrid(lcp.A, real=dtype), problem.cells.shape
        free = problem.fluid & (np.random.default_rng(517).random(shape) < 0.8)
        held = grid.vector()
        grid.set_free_set(
            lcp.A.layout.load(
                free.reshape(boxes.counts[::-1])[boxes.box.slices].reshape(lcp.A.shape), wp.uint8
            )
        )
        for matrix, expected in (
            (grid.operator, on_all_cells(problem, problem.fluid)),
            (grid.matrix, on_all_cells(problem, free)),
        ):
            x, v = random_vector(grid, boxes, shape, 29)
            y = expected @ x.ravel()
            for product in (matrix.mult, matrix.multTranspose):
                product(v, held)
                found = whole_field(grid.field(held), boxes, shape).ravel()
                assert np.abs(found - y).max() < accuracy * np.abs(y).max()
            matrix.getDiagonal(held)
            diagonal = whole_field(grid.field(held), boxes, shape).ravel()
            assert np.abs(diagonal - expected.diagonal()).max() < accuracy * np.abs(y).max()
        w = boxes.dmda.createGlobalVec()  # it has the numbering of the DMDA
        grid.operator.mult(w, w.duplicate())
        assert w.getOwnershipRange() == held.getOwnershipRange()


def preconditioner():
    """Test that the cycle is symmetric, positive definite and linear.

    Linear over 40 orders of magnitude; on held cells it is the identity.
    """
    problem = small("brick", "walls")
    boxes, lcp = shared_problem(problem, Ranks.world())
    grid, shape = PetscGrid(lcp.A), problem.cells.shape
    ksp = grid.solver()
    ksp.setUp()
    (a, u), (_, v) = (random_vector(grid, boxes, shape, seed) for seed in (31, 37))
    mu, mv, small_mu = grid.vector(), grid.vector(), grid.vector()
    ksp.getPC().apply(u, mu)
    ksp.getPC().apply(v, mv)
    assert abs(mu.dot(v) - u.dot(mv)) < 1e-6 * abs(mu.dot(u))
    assert mu.dot(u) > 0
    assert mv.dot(v) > 0
    other = ~problem.fluid
    assert np.array_equal(whole_field(grid.field(mu), boxes, shape)[other], a[other])
    u.scale(1e-40)
    ksp.getPC().apply(u, small_mu)
    small_mu.scale(1e40)
    small_mu.axpy(-1.0, mu)
    assert small_mu.norm() < 1e-6 * mu.norm()
    u.set(0.0)
    ksp.getPC().apply(u, mu)
    assert mu.norm() == 0


def linear_solves():
    """Compare KSP with a direct solution, also with PETSc options.

    A free set that changes is another matrix.
    """
    problem = small("cube", "walls")
    boxes, lcp = shared_problem(problem, Ranks.world())
    grid, shape = PetscGrid(lcp.A, real=wp.float64), problem.cells.shape
    options = petsc().Options()
    options["jacobi_pc_type"], options["jacobi_ksp_type"], options["jacobi_ksp_max_it"] = (
        "jacobi",
        "minres",
        500,
    )
    kinds = [grid.solver(), grid.solver("jacobi_")]
    assert [ksp.getType() for ksp in kinds] == ["cg", "minres"]
    for share in (1.1, 0.7):
        free = problem.fluid & (np.random.default_rng(61).random(shape) < share)
        grid.set_free_set(lcp.A.layout.load(free[boxes.box.slices], wp.uint8))
        x, b = random_vector(grid, boxes, shape, 41)
        expected = scipy.sparse.linalg.spsolve(on_all_cells(problem, free), x.ravel()).reshape(
            shape
        )
        for ksp, most in zip(kinds, (12, 500), strict=True):
            ksp.setTolerances(rtol=1e-10)
            found = grid.vector()
            ksp.solve(b, found)
            assert ksp.getConvergedReason() > 0
            assert ksp.getIterationNumber() <= most
            assert (
                np.abs(whole_field(grid.field(found), boxes, shape) - expected).max()
                < 1e-7 * np.abs(expected).max()
            )


def bounded_methods():
    """Solve by SNES and TAO methods for bounds, without a matrix.

    They take free sets out of the operator.
    """
    problem = small("cube", "walls")
    boxes, lcp = shared_problem(problem, Ranks.world())
    expected, _ = solve_ours(problem, wl.ProjectedMultigrid(), Ranks.world())
    grid, fluid = PetscGrid(lcp.A), problem.fluid
    operator, comm = grid.operator, boxes.ranks.comm
    options = petsc().Options()
    options["pc_type"], options["snes_vi_zero_tolerance"] = "jacobi", 1e-13
    least, most = petsc().NINFINITY, petsc().INFINITY
    fields = (
        problem.b,
        np.where(fluid, np.maximum(problem.lower, least), 0.0),
        np.where(fluid, most, 0.0),
    )
    b, lower, upper = (grid.vector(field[boxes.box.slices]) for field in fields)

    def energy(tao, x, gradient):
        operator.mult(x, gradient)
        value = 0.5 * x.dot(gradient) + x.dot(b)
        gradient.axpy(1.0, b)
        return value

    def by_tao(kind, x):
        tao = petsc().TAO().create(comm)
        tao.setType(kind)
        tao.setObjectiveGradient(energy, b.duplicate())
        tao.setHessian(lambda tao, x, H, P: None, operator)
        tao.setVariableBounds((lower, upper))
        tao.setTolerances(gatol=1e-9 * b.norm(), grtol=0.0, gttol=0.0)
        tao.setSolution(x)
        return tao

    def by_snes(kind, x):
        snes = petsc().SNES().create(comm)
        snes.setType(kind)
        snes.setFunction(lambda snes, x, f: operator.multAdd(x, b, f), b.duplicate())
        snes.setJacobian(lambda snes, x, J, P: None, operator)
        snes.setVariableBounds(lower, upper)
        snes.setTolerances(rtol=1e-11, atol=1e-11 * b.norm(), stol=0.0, max_it=100)
        snes.getKSP().setType("cg")
        return snes

    for kind, make in (("tron", by_tao), ("gpcg", by_tao), ("vinewtonrsls", by_snes)):
        x = b.duplicate()
        method = make(kind, x)
        method.getKSP().setTolerances(rtol=1e-8, max_it=2000)
        method.setFromOptions()
        method.solve(*([x] if make is by_tao else [None, x]))
        assert method.getConvergedReason() > 0, kind
        found = whole_field(grid.field(x), boxes, problem.cells.shape)[fluid]
        assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max(), kind


class AggregateSums:
    """Sums over aggregates of the next finer level's cells, by NumPy.

    The transpose, times a factor, is included.
    """

    def __init__(self, fine, coarse, factor):
        self.shapes = [level.stencil.padding.counts for level in (fine, coarse)]
        self.unknown = [inner(level.stencil, level.stencil.d) != 0 for level in (fine, coarse)]
        self.factor, self.by = factor, coarse.factors[::-1]

    def mult(self, matrix, x, y):
        field = np.where(self.unknown[0], x.getArray(readonly=True).reshape(self.shapes[0]), 0.0)
        for axis in range(3):
            field = np.add.reduceat(
                field, np.arange(0, field.shape[axis], self.by[axis]), axis=axis
            )
        y.setArray(np.where(self.unknown[1], field, 0.0).ravel())

    def multTranspose(self, matrix, x, y):  # noqa: N802  # PETSc's name
        field = np.where(self.unknown[1], x.getArray(readonly=True).reshape(self.shapes[1]), 0.0)
        for axis in range(3):
            field = np.repeat(field, self.by[axis], axis=axis).take(
                np.arange(self.shapes[0][axis]), axis=axis
            )
        y.setArray(np.where(self.unknown[0], self.factor * field, 0.0).ravel())


def inner(stencil, field):
    """Return a stored field without its ghost cells."""
    return field.numpy().reshape(stencil.padding.shape)[1:-1, 1:-1, 1:-1]


def cycles_of_pcmg():
    """Compare a cycle with that of PETSc's PCMG, on one rank.

    It has Chebyshev smoothing and matrices assembled from the levels, W and V.
    """
    problem, PETSc, options = small("brick", "walls"), petsc(), petsc().Options()
    for gamma in (2, 1):
        _, lcp = shared_problem(problem, Ranks.world())
        grid = PetscGrid(lcp.A, real=wp.float64, cycle=CycleSettings(gamma=gamma))
        levels, ours = grid.hierarchy.levels, grid.solver()
        ours.setUp()
        pc = PETSc.PC().create(PETSc.COMM_SELF)
        pc.setType("mg")
        pc.setMGLevels(len(levels))
        pc.setMGCycleType(PETSc.PC.MGCycleType.W if gamma == 2 else PETSc.PC.MGCycleType.V)
        matrices = [level_matrix(level.stencil) for level in levels]
        pc.setOperators(matrices[0])
        for k, level in enumerate(reversed(range(len(levels)))):
            smoother = pc.getMGSmoother(k)
            smoother.setOperators(matrices[level])
            if k == 0:
                smoother.setType("preonly")
                smoother.getPC().setType("lu")
                continue
            smoother.setType("chebyshev")
            options[f"mg_levels_{k}_ksp_chebyshev_eigenvalues"] = "0.5,2.0"
            smoother.setTolerances(max_it=2)
            smoother.setNormType(PETSc.KSP.NormType.NONE)
            smoother.getPC().setType("jacobi")
            smoother.setFromOptions()
            sizes = [m.getSize()[0] for m in (matrices[level], matrices[level + 1])]
            sums = AggregateSums(
                levels[level], levels[level + 1], grid.hierarchy.settings.over_correction
            )
            restriction = PETSc.Mat().createPython((sizes[1], sizes[0]), sums, comm=PETSc.COMM_SELF)
            restriction.setUp()
            pc.setMGRestriction(k, restriction)
            pc.setMGInterpolation(k, PETSc.Mat().createTranspose(restriction))
        pc.setUp()
        r = grid.vector(
            np.where(
                problem.fluid, np.random.default_rng(43).standard_normal(problem.cells.shape), 0.0
            )
        )
        z, expected = grid.vector(), grid.vector()
        ours.getPC().apply(r, z)
        pc.apply(r, expected)
        z.axpy(-1.0, expected)
        assert z.norm() < 1e-12 * expected.norm()


def released():
    """Make operators one after another, each after the last reference to the one before is gone.

    PETSc prints the objects that wait for all ranks to release them.
    """
    comm = Ranks.world().comm
    problem = shared_problem(small("brick", "walls"), Ranks.world())[1]
    for _ in range(3):
        grid = PetscGrid(problem.A)
        del grid
        gc.collect()
        petsc().garbage_view(comm)


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_ERROR
    for check in sys.argv[1:]:
        globals()[check]()
        sys.stdout.write(f"{check} ")
