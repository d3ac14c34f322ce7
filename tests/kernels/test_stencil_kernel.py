"""Row passes against NumPy.

Row segments, chunks and spans, sums, transfers, waves; messages about wrong launches.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from code_blocks import blocks, run
from oracle import assemble
from warp_lcp.kernels import FusedKernel, PrecomputedProduct, Rows, StencilKernel, layout
from warp_lcp.kernels import rows as kernel_rows
from warp_lcp.kernels.fields import Padding
from warp_lcp.kernels.header_text import text

SHAPE = (5, 6, 37)
RNG = np.random.default_rng(12345)


def row_pass(folder: Path, name: str, source: str, **declared) -> StencilKernel:
    header = folder / f"{name}.h"
    header.write_text(source)
    return StencilKernel(f"test_rows.{name}", header, "S", **declared)


@pytest.fixture(scope="module")
def product(tmp_path_factory):
    source = (
        "T xy = 0;\nSIMD for (int k = 0; k < n; ++k) { const T v = product(x, k); y[k] = v; "
        "xy += x[k]*v; }\n"
    )
    fields = {"reads": {"x": "S"}, "writes": {"y": "S"}, "sums": ("xy",)}
    return row_pass(
        tmp_path_factory.mktemp("headers"), "product", source, stencil=("D", "W"), **fields
    )


def scene(real, faces, **sides):
    cells = RNG.choice([wl.AIR, wl.FLUID, wl.SOLID], size=SHAPE, p=[0.2, 0.7, 0.1])
    A = wl.GridPoisson(cells, device="cpu", dtype=wp.float64, **faces, **sides)
    x = RNG.standard_normal(SHAPE) * (cells == wl.FLUID)
    return A, cells, A.layout.load(x, real), x


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
@pytest.mark.parametrize("faces", [{}, {"face_y": 3.0}], ids=str)
def test_a_product_and_its_sum(product, real, faces):
    A, cells, x, host = scene(real, faces)
    y, rows = wp.zeros_like(x), A.stencil.rows
    out = wp.zeros(rows.places, dtype=wp.float64, device="cpu")
    product.bind(rows, stencil=A.stencil, x=x, y=y, out=out).launch()
    expected = assemble(cells, [faces.get(f"face_{a}", 1.0) for a in "xyz"]) @ host.ravel()
    tol = 1e-5 if real is wp.float32 else 1e-12
    np.testing.assert_allclose(A.layout.unload(y).numpy().ravel(), expected, atol=tol)
    assert out.numpy().sum() == pytest.approx(host.ravel() @ expected, rel=10 * tol)


@pytest.mark.cpu_form("how many cells a thread takes")
def test_a_product_that_is_known_stands_for_a_stencil(tmp_path):
    source = (
        "T total = 0;\nSIMD for (int k = 0; k < n; ++k) { const T v = affine(x, b, "
        "k)*diagonal(k); y[k] = v; total += v; }\n"
    )
    fields = {"reads": {"x": "S", "b": "S"}, "writes": {"y": "S"}, "sums": ("total",)}
    scaled = row_pass(tmp_path, "scaled", source, stencil=("D", "W"), **fields)
    n = 20_000  # several chunks
    d, product = RNG.random(n), RNG.standard_normal(n)
    x, y, rows = (
        wp.zeros(n, dtype=wp.float64, device="cpu"),
        wp.zeros(n, dtype=wp.float64, device="cpu"),
        Rows.flat(n, wp.get_device("cpu")),
    )
    out = wp.zeros(rows.places, dtype=wp.float64, device="cpu")
    known = PrecomputedProduct(
        wp.array(d, dtype=wp.float64, device="cpu"),
        2.0,
        wp.array(product, dtype=wp.float64, device="cpu"),
    )
    scaled.bind(rows, stencil=known, x=x, b=x, y=y, out=out).launch()
    np.testing.assert_allclose(y.numpy(), 2 * d * product, rtol=1e-15)
    assert rows.places == 3 and out.numpy().sum() == pytest.approx(
        (2 * d * product).sum(), rel=1e-12
    )


@pytest.mark.parametrize(
    "rows",
    [
        Rows.flat(1000, wp.get_device("cpu"), serial=True),
        Rows.by_turns(1000, wp.get_device("cpu"), 64),
    ],
    ids=str,
)
def test_a_flat_field_goes_to_one_thread_or_by_turns_to_many(tmp_path, rows):
    """Flat field on one thread, or strided over many.

    The second is CUDA's way: thread t sums elements t, t + 64, ...; 1000 is no multiple of 64.
    """
    squares = row_pass(
        tmp_path,
        "squares",
        "T xx = 0;\nfor (int k = 0; k < n; ++k) { y[k] = p + k; xx += x[k]*x[k]; }\n",
        reads={"x": "S"},
        writes={"y": "S"},
        sums=("xx",),
    )
    host = RNG.standard_normal(1000)
    x, y, out = (
        wp.array(v, dtype=wp.float64, device="cpu")
        for v in (host, host, np.full(rows.places + 1, 9.0))
    )
    squares.bind(rows, x=x, y=y, out=out).launch()
    np.testing.assert_array_equal(y.numpy(), np.arange(1000))
    expected = (
        (host**2).sum() if rows.places == 1 else [(host[t::64] ** 2).sum() for t in range(64)]
    )
    np.testing.assert_allclose(out.numpy()[:-1], expected, rtol=1e-13)
    assert out.numpy()[-1] == 9.0


@pytest.mark.cpu_form("how many cells a thread takes")
@pytest.mark.parametrize("chunks", [2, 37])
def test_slabs_chunks_and_spans_share_the_same_cells_out(product, monkeypatch, chunks):
    """Slabs, chunks and spans that share the same cells.

    Two chunks a row, or as on CUDA a thread per cell; one place for the sums of several planes;
    cells outside the spans are not visited.
    """
    A, _, x, _ = scene(wp.float64, {})
    whole, y = wp.zeros_like(x), wp.zeros_like(x)
    out = wp.zeros(5 * 6 * 37, dtype=wp.float64, device="cpu")
    s = A.stencil
    product.bind(Rows.of(s.padding, s.device), stencil=s, x=x, y=whole, out=out).launch()
    total = out.numpy().sum()
    monkeypatch.setitem(kernel_rows.PLANES_A_THREAD, "cpu", 2)
    rows = Rows.of(s.padding, s.device)
    rows.summed.grain, rows.summed.chunks = -(-37 // chunks), chunks
    monkeypatch.undo()
    out.zero_()
    product.bind(rows, stencil=s, x=x, y=y, out=out).launch()
    np.testing.assert_array_equal(y.numpy(), whole.numpy())
    assert rows.places == 3 * 6 * chunks
    assert out.numpy()[: rows.places].sum() == pytest.approx(total, rel=1e-12)
    spans = np.zeros((5, 6, 2), dtype=np.int32)
    spans[2, 3] = (16, 32)
    y.fill_(7.0)
    product.bind(
        Rows.of(s.padding, s.device, wp.array(spans, dtype=wp.vec2i, device="cpu")),
        stencil=s,
        x=x,
        y=y,
        out=out,
    ).launch()
    stored, all_ = (f.numpy().reshape(7, 8, 39) for f in (y, whole))
    np.testing.assert_array_equal(stored[3, 4, 17:33], all_[3, 4, 17:33])
    stored[3, 4, 17:33] = 7.0
    assert (stored == 7.0).all()


def test_quads_are_for_kernels_whose_cells_do_not_depend_on_each_other(product, tmp_path):
    """Kernels that a thread on CUDA runs for four cells of a row at a time.

    A product can, a kernel in whose order of cells later ones read earlier ones cannot.
    """
    A, _, x, _ = scene(wp.float64, {})
    rows = A.stencil.rows
    out = wp.zeros(rows.places, dtype=wp.float64, device="cpu")
    bound = product.bind(rows, stencil=A.stencil, x=x, y=wp.zeros_like(x), out=out)
    form = bound.form.by_cells  # on CUDA the form of the launch itself is by quads
    assert form.by_quads is not None and form.by_quads.quads and not form.quads
    assert form.by_quads.by_cells.words == form.words
    ordered = row_pass(tmp_path, "ordered", ";", writes={"y": "S"}, ordered=True)
    assert ordered.bind(rows, y=x).form.by_quads is None


def test_a_fused_kernel_equals_its_kernels_in_sequence(product, tmp_path):
    add = row_pass(
        tmp_path,
        "add",
        "SIMD for (int k = 0; k < n; ++k) x[k] += step*z[k];\n",
        reads={"z": "S"},
        writes={"x": "S"},
        numbers={"step": "S"},
    )
    wave = FusedKernel("test_rows.wave", (add, 0), (product, 1))
    A, _, x, _ = scene(wp.float64, {})
    z, rows = wp.clone(x), A.stencil.rows
    found = []
    for together in (True, False):
        moved, y, out = (
            wp.clone(x),
            wp.zeros_like(x),
            wp.zeros(rows.places, dtype=wp.float64, device="cpu"),
        )
        passes = (
            add.bind(rows, z=z, x=moved, step=0.5),
            product.bind(rows, stencil=A.stencil, x=moved, y=y, out=out),
        )
        if together:
            wave.launch(*passes)
        else:
            passes[0].launch()
            wave.launch(None, passes[1])
        found.append([f.numpy() for f in (moved, y, out)])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(
        TypeError, match=r"test_rows.wave: takes test_rows.add, test_rows.product, in this order"
    ):
        wave.launch(*reversed(passes))


def test_fields_of_another_level_and_of_ghost_cells(tmp_path):
    """Fields of another level, and ghost cells.

    The aggregate of each cell is found, on either side; ghost cells are visited without their
    neighbors.
    """
    inject = row_pass(
        tmp_path,
        "inject",
        "for (int k = 0; k < n; ++k) x[k] = c[k/2];\n",
        writes={"x": "S"},
        other={"c": "S"},
    )
    fine, coarse = (Rows.of(Padding(n), wp.get_device("cpu")) for n in ((4, 5, 8), (2, 5, 4)))
    x, values = (
        wp.zeros(fine.size, dtype=wp.float32, device="cpu"),
        np.arange(coarse.size, dtype=np.float32),
    )
    c = wp.array(values, device="cpu")
    inject.bind(fine.beside(coarse, (-2, -1, -2)), x=x, c=c).launch()
    expected = values.reshape(4, 7, 6)[1:-1, 1:-1, 1:-1].repeat(2, 0).repeat(2, 2)
    np.testing.assert_array_equal(x.numpy().reshape(6, 7, 10)[1:-1, 1:-1, 1:-1], expected)
    one = row_pass(tmp_path, "one", "for (int k = 0; k < n; ++k) x[k] += 1;\n", writes={"x": "S"})
    x.zero_()
    for axis in range(3):
        for end in (0, 1):
            one.bind(Rows.beyond(Padding((4, 5, 8)), wp.get_device("cpu"), axis, end), x=x).launch()
    expected = np.zeros((6, 7, 10), dtype=np.float32)
    for at in (0, -1):
        expected[at, 1:-1, 1:-1] = expected[1:-1, at, 1:-1] = expected[1:-1, 1:-1, at] = 1
    np.testing.assert_array_equal(x.numpy().reshape(6, 7, 10), expected)


def wrong_launches():
    short = wp.zeros(3, dtype=wp.float32, device="cpu")
    yield {"y": ...}, TypeError, r"product: missing \['y'\], unknown \[\]"
    yield {"z": short}, TypeError, r"product: missing \[\], unknown \['z'\]"
    yield {"y": short}, ValueError, "product: y has 3 elements, not 2184"
    yield (
        {"y": wp.zeros(2184, dtype=wp.float64, device="cpu")},
        TypeError,
        "product: y is float64, not an array of float32, as x",
    )
    yield {"x": 1.0}, TypeError, "product: x is float, not an array"
    yield (
        {"out": wp.zeros(7, dtype=wp.float64, device="cpu")},
        ValueError,
        "product: out has 7 elements, fewer than 30",
    )
    yield {"out": short}, TypeError, "product: out is float32, not an array of float64"
    yield {"stencil": None}, TypeError, "product: needs stencil"
    yield {"bounds": []}, TypeError, "product: needs stencil, takes no bounds"


@pytest.mark.cpu_form("how many cells a thread takes")
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [*wrong_launches()],
    ids=lambda v: next(iter(v)) if isinstance(v, dict) else "",
)
def test_a_wrong_launch_is_named(product, change, error, message):
    A, _, x, _ = scene(wp.float32, {})
    out = wp.zeros(A.stencil.rows.places, dtype=wp.float64, device="cpu")
    given = {"stencil": A.stencil, "x": x, "y": wp.zeros_like(x), "out": out} | change
    with pytest.raises(error, match=message):
        product.bind(
            A.stencil.rows, **{name: value for name, value in given.items() if value is not ...}
        )


def test_a_changed_header_is_compiled_again(tmp_path):
    """Recompilation of a changed header.

    Headers are inserted as text, so that Warp's hash covers included ones; the compiler still
    reports file and line.
    """
    hashes = []
    for value in (1, 2):
        folder = tmp_path / str(value)
        folder.mkdir()
        (folder / "value.h").write_text(f"const int value = {value};\n")
        fill = row_pass(
            folder,
            "fill",
            '#include "value.h"\nfor (int k = 0; k < n; ++k) x[k] = value;\n',
            writes={"x": "S"},
        )
        x = wp.zeros(4, dtype=wp.float32, device="cpu")
        bound = fill.bind(Rows.flat(4, x.device), x=x)
        bound.launch()
        assert (x.numpy() == value).all()
        hashes.append(bound.form.kernel.module.hash_module())
        assert text(folder / "fill.h").splitlines()[:4] == [
            '#line 1 "fill.h"',
            '#line 1 "value.h"',
            f"const int value = {value};",
            '#line 2 "fill.h"',
        ]
    assert hashes[0] != hashes[1]


@pytest.mark.parametrize(
    ("example", "header", "form"),
    [(0, "energy", "uint8_float32_float32"), (1, "relax", "uint8_float32")],
)
def test_the_examples_of_a_new_pass_and_a_new_method_run_and_compile_for_cuda(
    tmp_path, monkeypatch, example, header, form
):
    page = Path(__file__).parents[2] / "CONTRIBUTING.md"
    source, code = blocks(page, "cpp")[example], blocks(page, "python")[example]
    assert len([line for line in (source + code).splitlines() if line]) <= 55
    (tmp_path / f"{header}.h").write_text(source)
    monkeypatch.chdir(tmp_path)
    run(code, page)
    for arch in (80, 90):
        wp.compile_aot_module(
            f"warp_lcp.mine.{header}.uniform_{form}",
            device=None,
            arch=arch,
            module_dir=tmp_path,
            use_ptx=True,
        )


def test_rows_beside_those_of_another_level_have_its_alignment():
    """Alignments of a pair: of both levels, so that threads may read blocks of both.

    With negative factors a thread takes the cells of one of the other level's threads, which begin
    anywhere.
    """
    own, coarse = layout.Alignment(2), layout.Alignment(1, either=True)
    rows, other = (
        replace(
            Rows.of(Padding(shape), wp.get_device("cpu")), alignments=(alignment, layout.ANYWHERE)
        )
        for shape, alignment in (((4, 6, 8), own), ((2, 3, 4), coarse))
    )
    assert rows.beside(other, (2, 2, 2)).alignments == (own, coarse)
    assert rows.beside(other, (-2, -2, -2)).alignments == (own, layout.ANYWHERE)
