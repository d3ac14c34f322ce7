"""A grid's matrix against the definition, face by face."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import assemble
from warp_lcp.operators.grid_matrix import grid_matrix


@pytest.mark.every_case
@pytest.mark.parametrize(
    "periodic",
    [(False, False, False), (True, False, False), (True, True, False), (True, True, True)],
)
@pytest.mark.parametrize("shape", [(1, 6), (4, 5), (3, 4, 5)])
def test_matrix_is_the_definition_s(shape, periodic):
    rng = np.random.default_rng([*shape, sum(periodic)])
    cells = rng.choice([0, 1, 1, 1, 2], size=shape)
    axes = len(shape)
    wraps = [wrap and n > 1 for wrap, n in zip(periodic, (*shape[::-1], 1), strict=False)]
    faces = []
    for axis in range(axes):
        face = rng.random([n + (a == axes - 1 - axis) for a, n in enumerate(shape)])
        if wraps[axis]:
            np.moveaxis(face, axes - 1 - axis, 0)[0] = np.moveaxis(face, axes - 1 - axis, 0)[-1]
        faces.append(face)
    shift = rng.random(shape)
    names = {f"face_{name}": face for name, face in zip("xyz", faces, strict=False)}
    A = wl.GridPoisson(
        cells, **names, shift=shift, periodic=periodic, device="cpu", dtype=wp.float64
    )
    fluid = cells.ravel() == 1
    expected = assemble(cells, (*faces, 1.0, 1.0)[:3], shift, (*wraps, False, False)[:3])[
        np.ix_(fluid, fluid)
    ]
    np.testing.assert_allclose(grid_matrix(A).toarray(), expected, rtol=1e-14, atol=1e-15)
