"""Passes in one launch: each reads the results of those before it.

Any number of threads may share the rows.
"""

import numpy as np
import pytest
import warp as wp

from warp_lcp.kernels import PersistentKernel, Rows, StencilKernel
from warp_lcp.kernels.fields import Padding

COUNTS = (3, 4, 21)


@pytest.fixture(scope="module")
def passes(tmp_path_factory):
    """Return y = x + below, and x = factor y; `below` is the row under this one."""
    folder = tmp_path_factory.mktemp("headers")
    (folder / "add.h").write_text("for (int k = 0; k < n; ++k) y[k] = x[k] + x[k + ym];\n")
    (folder / "scale.h").write_text("for (int k = 0; k < n; ++k) x[k] = factor*y[k];\n")
    add = StencilKernel(
        "test_sequence.add", folder / "add.h", "S", reads={"x": "S"}, writes={"y": "S"}
    )
    return add, StencilKernel(
        "test_sequence.scale",
        folder / "scale.h",
        "S",
        reads={"y": "S"},
        writes={"x": "S"},
        numbers={"factor": "S"},
    )


@pytest.mark.every_case
@pytest.mark.parametrize("threads", [1, 5, 64])
@pytest.mark.parametrize("cells", [1, 7, 21])
def test_stages_follow_each_other(passes, cells, threads):
    add, scale = passes
    padding = Padding(COUNTS)
    rows = Rows.strided(
        padding.size,
        wp.get_device("cpu"),
        (padding.plane + padding.row + 1, padding.plane, padding.row),
        COUNTS,
        cells=cells,
    )
    host = np.zeros(padding.shape)
    host[1:-1, 1:-1, 1:-1] = np.random.default_rng(3).standard_normal(COUNTS)
    x = wp.array(host.ravel(), dtype=wp.float64, device="cpu")
    y = wp.zeros_like(x)
    adding, halving, doubling = (
        add.bind(rows, x=x, y=y),
        scale.bind(rows, x=x, y=y, factor=0.5),
        scale.bind(rows, x=x, y=y, factor=2.0),
    )
    sequence = PersistentKernel("test_sequence.all", [adding, halving, adding, adding, doubling])
    assert len(sequence.tables.order) == 5
    assert len(sequence.tables.pieces0) == 1  # equal objects are stored once
    if threads == 1:
        sequence.launch()
    else:  # barriers are CUDA's: a launch per stage replaces them here
        for i in range(5):
            wp.launch(sequence.kernel, threads, [sequence.tables, i, i + 1, threads], device="cpu")
    expected, inner = host, (slice(1, -1),) * 3
    for factor in (0.5, 2.0):
        total = np.zeros_like(expected)
        total[inner] = factor * (expected[inner] + expected[1:-1, :-2, 1:-1])
        expected = total
    np.testing.assert_allclose(x.numpy().reshape(host.shape), expected, rtol=1e-15)


@pytest.mark.cpu_form("how many cells a thread takes")
def test_unsupported_members_are_refused(passes, tmp_path):
    rows, x = Rows.flat(8, wp.get_device("cpu")), wp.zeros(8, dtype=wp.float64, device="cpu")
    (tmp_path / "sum.h").write_text("T s = 0; for (int k = 0; k < n; ++k) s += x[k];\n")
    total = StencilKernel(
        "test_sequence.sum", tmp_path / "sum.h", "S", reads={"x": "S"}, sums=("s",)
    )
    with pytest.raises(
        ValueError, match=r"test_sequence\.sum sums, which passes of a sequence cannot"
    ):
        PersistentKernel(
            "test_sequence.wrong",
            [total.bind(rows, x=x, out=wp.zeros(1, dtype=wp.float64, device="cpu"))],
        )
    (tmp_path / "set.h").write_text("for (int k = 0; k < n; ++k) x[k] = KIND;\n")
    many = StencilKernel(
        "test_sequence.set", tmp_path / "set.h", "S", writes={"x": "S"}, constants={"KIND": 0}
    )
    with pytest.raises(ValueError, match="are 6 forms: a sequence takes 5"):
        PersistentKernel(
            "test_sequence.wrong", [many.bind(rows, x=x, KIND=kind) for kind in range(6)]
        )
