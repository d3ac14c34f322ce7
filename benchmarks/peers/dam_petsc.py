"""The dam by PETSc's SNESVI; `dam.py` runs this program.

It uses grid sequencing on doubled grids, Newton steps on the free set, and geometric multigrid.
"""

import gc
import json
import sys
import time

import numpy as np
import petsc4py

petsc4py.init(sys.argv[2:])
from petsc4py import PETSc  # noqa: E402


def problem(nx, ny, width, high, low):
    """Return matrix and right-hand side of the dam, A w = c.

    Rows include border nodes. The problem is -Laplace w + 1 >= 0 times hx hy.
    """
    x, y = np.linspace(0, width, nx), np.linspace(0, high, ny)
    w = np.zeros((ny, nx))
    w[0] = (high**2 * (width - x) + low**2 * x) / (2 * width)
    w[:, 0], w[:, -1] = (high - y) ** 2 / 2, np.where(y < low, (low - y) ** 2 / 2, 0.0)
    across, along = y[1] / x[1], x[1] / y[1]
    inner = np.zeros((ny, nx), dtype=bool)
    inner[1:-1, 1:-1] = True
    k = np.arange(nx * ny, dtype=np.int32).reshape(ny, nx)
    size = np.where(inner, 5, 1)
    starts = np.concatenate([[0], np.cumsum(size.ravel())]).astype(np.int32)
    columns, values = np.empty(starts[-1], dtype=np.int32), np.empty(starts[-1])
    own = k[~inner]
    columns[starts[own]], values[starts[own]] = own, 1.0
    rows = k[inner]
    entries = ((-nx, -along), (-1, -across), (0, 2 * (across + along)), (1, -across), (nx, -along))
    for place, (step, value) in enumerate(entries):
        columns[starts[rows] + place], values[starts[rows] + place] = rows + step, value
    return (starts, columns, values), np.where(inner, -x[1] * y[1], w).ravel()


def solve(dm, nx, ny, guess, rtol, sizes):
    """Solve on one grid; return the solver and its solution."""
    (starts, columns, values), right = problem(nx, ny, **sizes)
    A = PETSc.Mat().createAIJ((nx * ny,) * 2, csr=(starts, columns, values))
    del starts, columns, values  # memory is scarce on the finest grid
    c = PETSc.Vec().createWithArray(right)
    snes = PETSc.SNES().create()
    snes.setDM(dm)
    snes.setType("vinewtonrsls")

    def function(_, w, f):
        A.mult(w, f)
        f.axpy(-1.0, c)

    f, x, low, high = (dm.createGlobalVector() for _ in range(4))
    snes.setFunction(function, f)
    snes.setJacobian(lambda *_: None, A, A)
    low.set(0.0)
    high.set(PETSc.INFINITY)
    snes.setVariableBounds(low, high)
    snes.setTolerances(rtol=rtol, atol=0.0, stol=0.0, max_it=200)
    snes.setFromOptions()
    x.set(0.0) if guess is None else guess.copy(x)
    snes.solve(None, x)
    return snes, x


def main():
    """Print seconds, iterations and the answer at a node as JSON."""
    request = json.loads(sys.argv[1])
    sizes, rtol = request["sizes"], request["rtol"]
    start_time = time.perf_counter()
    nx, ny, levels = request["coarsest"][0], request["coarsest"][1], request["levels"]
    dm = PETSc.DMDA().create([nx, ny], dof=1, stencil_width=1)
    snes: PETSc.SNES | None = None
    x: PETSc.Vec | None = None
    guess, steps = None, []
    for level in range(levels):
        if level:
            finer = dm.refine()
            interpolation, _ = dm.createInterpolation(finer)
            guess = finer.createGlobalVector()
            interpolation.mult(x, guess)
            interpolation.destroy()
            assert snes is not None and x is not None
            snes.destroy()
            x.destroy()
            gc.collect()
            dm, nx, ny = finer, 2 * nx - 1, 2 * ny - 1
        snes, x = solve(dm, nx, ny, guess, rtol, sizes)
        steps.append(
            (
                nx,
                ny,
                snes.getIterationNumber(),
                snes.getLinearSolveIterations(),
                snes.getConvergedReason(),
            )
        )
    assert snes is not None and x is not None
    w = x.getArray().reshape(ny, nx)
    answer = {
        "seconds": time.perf_counter() - start_time,
        "steps": steps,
        "wet": int((w > 0).sum()),
        "norm": float(np.linalg.norm(w[1:-1, 1:-1])),
    }
    sys.stdout.write(
        json.dumps({**answer, "version": ".".join(map(str, PETSc.Sys.getVersion()))}) + "\n"
    )


main()
