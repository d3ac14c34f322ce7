"""Program for ranks: compare PETSc's own methods with ours on a small problem.

Usage: petsc_oracles.py NAME with a name of `oracle_problems.small`. PETSc has an assembled matrix.
Rank 0 prints one JSON object: the results of each method for all bounds.
"""

import json
import sys

import numpy as np
import scipy.sparse
import warp as wp
from oracle_problems import BOUNDS, small

import warp_lcp as wl
from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.launch import petsc
from warp_lcp.distributed.ranks import Ranks

OURS = {"newton": wl.MinimumMapNewton(), "multigrid": wl.ProjectedMultigrid()}
TIGHT = wl.StoppingCriteria(rtol=1e-10)


def shared_matrix(A):
    """Return a SciPy matrix as PETSc's, its rows distributed in their order."""
    matrix = petsc().Mat().createAIJ(A.shape, nnz=7)
    first, last = matrix.getOwnershipRange()
    mine = A[first:last]
    matrix.setValuesCSR(mine.indptr.astype(np.int32), mine.indices.astype(np.int32), mine.data)
    matrix.assemble()
    return matrix


def shared_vector(matrix, values):
    """Return values as a vector that fits the matrix; infinite ones as PETSc's."""
    v = matrix.createVecLeft()
    first, last = v.getOwnershipRange()
    v.setArray(np.clip(values[first:last], petsc().NINFINITY, petsc().INFINITY))
    return v


def gathered(v):
    """Return a vector's values on every rank."""
    return np.concatenate(Ranks.world().comm.allgather(v.getArray()))


def direct(ksp):
    """Solve by a factorization of the whole matrix on every rank.

    On some rank the matrix of a free set may have no row.
    """
    ksp.setType("preonly")
    ksp.getPC().setType("redundant")


def iterative(ksp):
    """Solve by conjugate gradients with Jacobi."""
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    ksp.setTolerances(rtol=1e-10, max_it=2000)


def snes(problem, A, kind, prepare):
    """Solve by PETSc's SNES for variational inequalities, F(x) = A x + b."""
    matrix = shared_matrix(A)
    fluid = problem.fluid
    b, lower, upper = (
        shared_vector(matrix, field[fluid]) for field in (problem.b, problem.lower, problem.upper)
    )
    options = petsc().Options()
    # Absolute tolerance, 1e-8 by default: it would count bounds as active that are not.
    options["snes_vi_zero_tolerance"] = 1e-13
    solver = petsc().SNES().create()
    solver.setType(kind)
    solver.setFunction(lambda snes, x, f: matrix.multAdd(x, b, f), b.duplicate())
    # vinewtonssls scales the rows in place.
    solver.setJacobian(lambda snes, x, J, P: matrix.copy(P), matrix.duplicate(copy=True))
    solver.setVariableBounds(lower, upper)
    solver.setTolerances(rtol=1e-11, atol=1e-11 * b.norm(), stol=0.0, max_it=100)
    prepare(solver.getKSP())
    solver.setFromOptions()
    x = b.duplicate()
    solver.solve(None, x)
    return gathered(x), solver.getConvergedReason(), solver.getIterationNumber()


def tao(problem, A, kind):
    """Solve by PETSc's TAO, as the quadratic program whose optimality is the LCP."""
    matrix = shared_matrix(A)
    fluid = problem.fluid
    b, lower, upper = (
        shared_vector(matrix, field[fluid]) for field in (problem.b, problem.lower, problem.upper)
    )

    def energy(tao, x, gradient):
        matrix.mult(x, gradient)
        value = 0.5 * x.dot(gradient) + x.dot(b)
        gradient.axpy(1.0, b)
        return value

    solver = petsc().TAO().create()
    solver.setType(kind)
    solver.setObjectiveGradient(energy, b.duplicate())
    solver.setHessian(lambda tao, x, H, P: None, matrix)
    solver.setVariableBounds((lower, upper))
    solver.setTolerances(gatol=1e-9 * b.norm(), grtol=0.0, gttol=0.0)
    solver.setMaximumIterations(300)
    x = b.duplicate()
    solver.setSolution(x)
    solver.getKSP().setTolerances(rtol=1e-8, max_it=2000)
    solver.solve(x)
    return gathered(x), solver.getConvergedReason(), solver.getIterationNumber()


THEIRS = {
    "vinewtonrsls, direct": lambda p, A: snes(p, A, "vinewtonrsls", direct),
    "vinewtonrsls, cg": lambda p, A: snes(p, A, "vinewtonrsls", iterative),
    "vinewtonssls, direct": lambda p, A: snes(p, A, "vinewtonssls", direct),
    "tron": lambda p, A: tao(p, A, "tron"),
    "gpcg": lambda p, A: tao(p, A, "gpcg"),
}


def shared_problem(problem, ranks, dtype=wp.float64):
    """Return the boxes of the ranks and their distributed problem."""
    counts = (*reversed(problem.cells.shape), 1)[:3]
    boxes = Decomposition(counts, ranks)

    def own_part(field, extra=(0, 0, 0)):
        z, y, x = (slice(s.start, s.stop + e) for s, e in zip(boxes.box.slices, extra, strict=True))
        grid = field.reshape([n + e for n, e in zip(reversed(counts), extra, strict=True)])[z, y, x]
        return np.ascontiguousarray(grid[0] if problem.cells.ndim == 2 else grid)

    coefficients = dict(problem.coefficients)
    for axis, name in enumerate(("face_z", "face_y", "face_x")):
        if np.ndim(coefficients.get(name, 1.0)):
            coefficients[name] = own_part(
                coefficients[name], tuple(int(a == axis) for a in range(3))
            )
    if "shift" in coefficients:
        coefficients["shift"] = own_part(coefficients["shift"])
    A = wl.GridPoisson(
        own_part(problem.cells), decomposition=boxes, device="cpu", dtype=dtype, **coefficients
    )
    return boxes, wl.LCP(A, own_part(problem.b), own_part(problem.lower), own_part(problem.upper))


def whole_field(mine, boxes, shape):
    """Return a field of the whole grid on every rank, from the boxes of the ranks."""
    whole = np.zeros(tuple(reversed(boxes.counts)))
    for box, part in boxes.ranks.comm.allgather((boxes.box.slices, mine)):
        whole[box] = part.reshape(whole[box].shape)
    return whole.reshape(shape)


def solve_ours(problem, solver, ranks):
    """Solve by one of our methods on the ranks.

    Return x on all unknowns, in their order, and the result.
    """
    boxes, lcp = shared_problem(problem, ranks)
    result = wl.solve(lcp, solver, stopping=TIGHT)
    return whole_field(result.x.numpy(), boxes, problem.cells.shape)[problem.fluid], result


def level_matrix(stencil):
    """Return a level's stencil of one rank as an assembled matrix on all cells.

    It is the identity on cells that are no unknowns.
    """
    counts, grid = (
        stencil.padding.counts,
        np.arange(np.prod(stencil.padding.counts)).reshape(stencil.padding.counts),
    )
    inside = (slice(1, -1),) * 3
    d = stencil.d.numpy().reshape(stencil.padding.shape)[inside].astype(float) * stencil.unit
    matrix = scipy.sparse.diags_array(np.where(d == 0, 1.0, d).ravel()).tolil()
    for axis, w in zip((2, 1, 0), stencil.weights, strict=True):
        weight = w.numpy().reshape(stencil.padding.shape)[inside]
        above, below = (
            (slice(None),) * axis + (cut,)
            for cut in (slice(1, None), slice(None, counts[axis] - 1))
        )
        joined = (d[above] != 0) & (d[below] != 0)
        i, j = grid[above][joined], grid[below][joined]
        matrix[i, j] = matrix[j, i] = -weight[above][joined]
    return shared_matrix(matrix.tocsr())


def compare(problem):
    """Solve by all methods and compare with our first one.

    Return the reports of each, and the differences of x and of the active set.
    """
    A, figures, reference = problem.matrix(), {}, None
    for name, solver in OURS.items():
        x, result = solve_ours(problem, solver, Ranks.world())
        places = problem.places(A, x)
        reference = reference or (x, places)
        figures[name] = {
            "converged": bool(result),
            "iterations": result.iterations,
            "linear_iterations": result.linear_iterations,
            "residual": result.residual,
            "residual_by_scipy": float(np.linalg.norm(problem.natural_residual(A, x))),
            **differences(x, places, *reference),
        }
    for name, solve in THEIRS.items():
        x, reason, iterations = solve(problem, A)
        figures[name] = {
            "converged": reason > 0,
            "iterations": iterations,
            **differences(x, problem.places(A, x), *reference),
        }
    return figures


def differences(x, places, other_x, other_places):
    """Return the difference of two solutions, the error relative to the largest x."""
    held = [int((places < 0).sum()), int((places > 0).sum())]
    error = float(np.abs(x - other_x).max() / np.abs(other_x).max())
    return {"error": error, "held": held, "held_otherwise": int((places != other_places).sum())}


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_ERROR
    found = {
        f"{name}, {bounds}": compare(small(name, bounds))
        for name in sys.argv[1:]
        for bounds in BOUNDS
    }
    if Ranks.world().is_root:
        print(json.dumps(found))
