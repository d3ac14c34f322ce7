"""Product with a stencil for PETSc, on vectors of the host: PETSc itself is not needed."""

import numpy as np
import pytest

import warp_lcp as wl
from oracle import assemble
from warp_lcp.extras.petsc_matrix import StencilMatrix, VectorCopies


class HostVector:
    """Array with the access of a PETSc.Vec."""

    def __init__(self, values):
        self.values = values

    def getArray(self, readonly=False):  # noqa: N802  # PETSc's name
        """Return the memory of the vector."""
        return self.values


@pytest.mark.parametrize("shape", [(5, 7), (3, 4, 5)])
def test_the_product_is_that_of_the_unknowns_and_the_identity_beside_them(shape):
    """B = A on the unknowns, for x = 0 elsewhere; the identity on the other cells."""
    rng = np.random.default_rng(631)
    cells = rng.choice([wl.AIR, wl.FLUID, wl.SOLID], shape, p=[0.2, 0.6, 0.2])
    stencil = wl.GridPoisson(cells, device="cpu").stencil
    matrix = StencilMatrix(stencil, VectorCopies(stencil, None))
    fluid = cells.ravel() == wl.FLUID
    A = assemble(cells, [1.0] * 3, None, (False,) * 3)
    for _ in range(2):  # fields of the first product do not enter the second
        x, y = rng.standard_normal(cells.size), np.zeros(cells.size)
        matrix.mult(None, HostVector(x), HostVector(y))
        np.testing.assert_allclose(y, np.where(fluid, A @ np.where(fluid, x, 0.0), x), atol=1e-12)
