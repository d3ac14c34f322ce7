"""Refusals and edge cases of passes, rows, waves and sequences.

Memory, names, empty grids, omitted stages.
"""

import gc
import weakref
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.kernels import FusedKernel, PersistentKernel, PrecomputedProduct, Rows, StencilKernel
from warp_lcp.kernels.fields import Padding
from warp_lcp.kernels.launch_graph import CommandBuffer

CPU, EACH = wp.get_device("cpu"), "for (int k = 0; k < n; ++k) "


def zeros(shape, dtype=wp.float64):
    return wp.zeros(shape, dtype=dtype, device="cpu")


def array(values):
    return wp.array(np.asarray(values), dtype=wp.float64, device="cpu")


@pytest.fixture
def row_pass(tmp_path):
    def made(name, source, compute="S", **declared):
        (tmp_path / f"{name}.h").write_text(source)
        return StencilKernel(f"test_misuse.{name}", tmp_path / f"{name}.h", compute, **declared)

    return made


@pytest.fixture
def double(row_pass):
    return row_pass(
        "double",
        EACH + "y[k] = x ? 2*x[k] : -1;",
        reads={"x": "S"},
        writes={"y": "S"},
        optional=("x",),
    )


@pytest.fixture
def add(row_pass):
    return row_pass("add", EACH + "y[k] += AMOUNT;", writes={"y": "S"}, constants={"AMOUNT": 1})


def test_elements_lie_side_by_side_on_the_rows_device(double):
    numbers, y, rows = array(np.arange(20.0)), zeros(10), Rows.flat(10, CPU)
    double.bind(rows, x=numbers[5:15], y=y).launch()
    np.testing.assert_array_equal(y.numpy(), 2 * np.arange(5, 15))
    for strided in (
        numbers[::2],
        wp.indexedarray(numbers, [wp.array(np.arange(10), dtype=int, device="cpu")]),
    ):
        with pytest.raises(ValueError, match=r"misuse\.double: x is strided"):
            double.bind(rows, x=strided, y=y)
    with pytest.raises(ValueError, match=r"misuse\.double: x is on cpu, not .*cuda:7"):
        double.bind(replace(rows, device=SimpleNamespace(alias="cuda:7")), x=y, y=y)


@dataclass(frozen=True, slots=True)
class ManyFields:
    """More fields than a kernel takes: arrays of any length."""

    x: Any
    y: Any
    other: int = 0


@dataclass(frozen=True, slots=True)
class SingleField:
    """Single field."""

    y: Any


def test_a_kernel_takes_the_members_of_structs_that_it_declares(double):
    x, y, z, rows = array(np.arange(10.0)), zeros(10), zeros(10), Rows.flat(10, CPU)
    double.bind(rows, ManyFields(x, y)).launch()
    np.testing.assert_array_equal(y.numpy(), 2 * np.arange(10))
    double.bind(rows, ManyFields(x, y), y=z, x=y).launch()  # keywords override members
    np.testing.assert_array_equal(z.numpy(), 4 * np.arange(10))
    double.bind(rows, SingleField(z), x=x).launch()
    np.testing.assert_array_equal(z.numpy(), y.numpy())
    with pytest.raises(
        TypeError, match=r"misuse\.double: missing \['x'\] in SingleField, unknown \[\]"
    ):
        double.bind(rows, SingleField(z))
    with pytest.raises(TypeError, match=r"misuse\.double: missing \[\], unknown \['other'\]"):
        double.bind(rows, ManyFields(x, y), other=0)
    with pytest.raises(
        TypeError, match=r"misuse\.double: ManyFields, SingleField: two of them have \['y'\]"
    ):
        double.bind(rows, ManyFields(x, y), SingleField(z))
    with pytest.raises(TypeError, match=r"misuse\.double: dict is not a dataclass"):
        double.bind(rows, {"x": x, "y": y})
    with pytest.raises(ValueError, match=r"misuse\.double: y has 9 elements, not 10"):
        double.bind(rows, ManyFields(x, zeros(9)))


@pytest.mark.parametrize(
    "absent", [None, zeros(0), zeros(20)[5:5]], ids=["None", "empty", "a slice of nothing"]
)
def test_absent_arrays_have_no_address(double, absent):
    y = zeros(10)
    double.bind(Rows.flat(10, CPU), x=absent, y=y).launch()
    assert (y.numpy() == -1).all()


def test_stencils_and_bounds_of_another_grid_are_refused(row_pass):
    one, other = (
        wl.GridPoisson(np.ones(shape, dtype=int), device="cpu") for shape in ((3, 4, 5), (9, 9, 9))
    )
    y, fields = zeros(other.layout.size), {"writes": {"y": "S"}}
    with pytest.raises(
        ValueError, match=r"misuse\.product: the stencil has 210 elements, not 1331"
    ):
        row_pass("product", ";", stencil=("D", "W"), **fields).bind(
            other.stencil.rows, stencil=one.stencil, y=y
        )
    bounds = wl.LCP(
        one, np.zeros(one.shape), np.linspace(-1, 1, 60).reshape(one.shape)
    ).bounds.operands
    with pytest.raises(ValueError, match=r"misuse\.bounded: bounds have 210 elements, not 1331"):
        row_pass("bounded", ";", bounds=True, **fields).bind(other.stencil.rows, bounds=bounds, y=y)
    with pytest.raises(TypeError, match="a known product is float32, not an array of float64"):
        assert PrecomputedProduct(zeros(8), 1.0, zeros(8, wp.float32)).struct
    with pytest.raises(ValueError, match=r"a known product has shape \(3,\): expected \(8,\)"):
        assert PrecomputedProduct(zeros(8), 1.0, zeros(3)).struct
    with pytest.raises(TypeError, match="the stencil's wy is float64, not an array of float32"):
        assert replace(one.stencil, weights=(zeros(210, wp.float32), zeros(210), zeros(210))).struct


def test_a_box_lies_within_its_fields(row_pass):
    fill = row_pass(
        "box", "for (int i = first; i < last; ++i) y[i] = 1;", wp.float64, box={"y": wp.float64}
    )
    for high, shape in (((3, 3, 4), (3, 3, 3)), ((1, 3, 3), (3, 3))):
        with pytest.raises(
            ValueError,
            match=r"misuse\.box: fields have the shape \(3, .*the box ends at \(., 3, .\)",
        ):
            fill.bind(Rows.box((0, 0, 0), high, CPU), y=zeros(shape))
    for low, high in (((-1, 0, 0), (3, 3, 3)), ((2, 2, 2), (3, 1, 3))):
        with pytest.raises(
            ValueError, match=r"box: from \(.*\) to \(.*\): expected 0 <= low <= high"
        ):
            Rows.box(low, high, CPU)
    y = zeros((3, 3, 3))
    for empty in ((2, 2, 0), (2, 0, 2), (0, 2, 2)):
        fill.bind(Rows.box((0, 0, 0), empty, CPU), y=y).launch()
    assert not y.numpy().any()


WRONG_NAMES = {
    "in two roles": ({"reads": {"y": "S"}}, "y"),
    "a number, too": ({"numbers": {"y": int}}, "y"),
    "the sums'": ({"reads": {"out": "S"}, "sums": ("s",)}, "out"),
    "of an argument": ({"reads": {"rows": "S"}}, "rows"),
    "of the layer": ({"numbers": {"n": int}}, "n"),
    "a ring of nothing": ({"ring": ("x",)}, "x"),
    "a letter of numbers alone": ({"numbers": {"v": "R"}}, "R"),
    "no name": ({"reads": {"2x": "S"}}, "2x"),
}


@pytest.mark.parametrize(("declared", "name"), WRONG_NAMES.values(), ids=WRONG_NAMES)
def test_names_are_checked_when_a_pass_is_declared(row_pass, declared, name):
    with pytest.raises(ValueError, match=rf"misuse\.wrong: \['{name}'\]"):
        row_pass("wrong", ";", writes={"y": "S"}, **declared)


def test_other_invalid_declarations_are_refused(row_pass):
    with pytest.raises(ValueError, match=r"misuse\.my-pass: \['my-pass'\]"):
        row_pass("my-pass", ";", writes={"y": "S"})
    with pytest.raises(
        TypeError, match=r"misuse\.wrong: \['v'\]: expected numbers of the types float32, "
    ):
        row_pass("wrong", ";", writes={"y": "S"}, numbers={"v": wp.uint8})
    with pytest.raises(ValueError, match=r"misuse\.wrong: \['x'\]"):  # s1 and s2 are its shape
        row_pass("wrong", ";", wp.float64, box={"x": wp.float64, "y": wp.float64}, optional=("x",))
    with pytest.raises(
        TypeError, match=r"misuse\.halves: y is float16: a letter stands for uint8, "
    ):
        row_pass("halves", ";", writes={"y": "S"}).bind(Rows.flat(3, CPU), y=zeros(3, wp.float16))


def test_constants_keep_their_fractions_and_numbers_their_range(row_pass):
    half = row_pass(
        "half",
        EACH + "y[k] = HALF + v;",
        writes={"y": "S"},
        constants={"HALF": 0.5},
        numbers={"v": wp.int64},
    )
    y, rows = zeros(3), Rows.flat(3, CPU)
    half.bind(rows, y=y, v=-(1 << 40)).launch()
    assert (y.numpy() == 0.5 - 2.0**40).all()
    replace(half, name="test_misuse.quarter", constants={"HALF": np.float32(0.25)}).bind(
        rows, y=y, v=0
    ).launch()
    assert (y.numpy() == 0.25).all()
    half.bind(rows, y=y, v=0, HALF=-3).launch()
    assert (y.numpy() == -3).all()
    with pytest.raises(TypeError, match=r"misuse\.half: HALF are integers where given"):
        half.bind(rows, y=y, v=0, HALF=2.7)
    for wrong in (1 << 63, 1.5, None):
        with pytest.raises(TypeError, match=r"misuse\.half: v = "):
            half.bind(rows, y=y, v=wrong)


def test_a_number_named_places_does_not_move_sums(row_pass):
    source = "T a = 0, b = 0; " + EACH + "{ a += x[k]; b += 2*x[k]; }"
    sums = row_pass("sums", source, reads={"x": "S"}, numbers={"places": int}, sums=("a", "b"))
    x, rows = array(np.arange(20_000.0)), Rows.flat(20_000, CPU)
    out = zeros(2 * rows.places)
    sums.bind(rows, x=x, places=1, out=out).launch()
    np.testing.assert_array_equal(
        out.numpy().reshape(2, -1).sum(axis=1), x.numpy().sum() * np.array([1, 2])
    )


def test_a_rewritten_header_is_read_again(row_pass):
    y = zeros(3)
    for value in (1, 2):
        fill = row_pass("anew", EACH + f"y[k] = {value};", writes={"y": "S"})
        fill.bind(Rows.flat(3, CPU), y=y).launch()
        assert (y.numpy() == value).all()


def test_grids_without_cells_are_left_alone(add, row_pass):
    total = row_pass("total", "T s = 0; " + EACH + "s += x[k];", reads={"x": "S"}, sums=("s",))
    total.bind(Rows.flat(0, CPU), x=zeros(0), out=zeros(0)).launch()
    grids = [Rows.of(Padding(counts), CPU) for counts in ((0, 2, 2), (2, 0, 2), (2, 2, 0))]
    for rows in (
        *grids,
        Rows.flat(0, CPU),
        Rows.flat(0, CPU, serial=True),
        Rows.by_turns(0, CPU, 64),
    ):
        y = zeros(rows.size)
        bound = add.bind(rows, y=y)
        bound.launch()
        PersistentKernel(
            "test_misuse.none", [bound]
        ).launch()  # a division by 0 rows crashed the process
        assert not y.numpy().any() and rows.places == 0


@pytest.mark.cpu_form("how many cells a thread takes")
def test_invalid_rows_are_refused(double):
    with pytest.raises(ValueError, match=r"rows: counts \(1, 1, 2147483648\)"):
        Rows.flat(1 << 31, CPU)
    with pytest.raises(ValueError, match=r"spans has shape \(2, 2\): expected \(4, 4\)"):
        Rows.of(Padding((4, 4, 4)), CPU, zeros((2, 2), wp.vec2i))
    with pytest.raises(TypeError, match="spans is int32, not an array of vec2i"):
        Rows.of(Padding((4, 4, 4)), CPU, zeros((4, 4), wp.int32))
    with pytest.raises(ValueError, match="planes: 1: expected at least 2"):
        Rows.of(Padding((1, 4, 4)), CPU).after_ghosts()
    one, other = Rows.of(Padding((2, 2, 4)), CPU), Rows.of(Padding((2, 2, 8)), CPU)
    assert [one.beside(other, (f, 1, 1)).single.fx for f in (2, 1, 2)] == [2, 1, 2]


def test_fused_kernels_reach_all_planes_with_any_member_left_out(add):
    rows = Rows.of(Padding((5, 3, 3)), CPU)
    y = zeros(rows.size)
    for lags in ((0, 1, 2), (0, 1, 0)):
        wave = FusedKernel("test_misuse.three", *zip((add,) * 3, lags, strict=True))
        for left_out in range(8):
            y.zero_()
            wave.launch(
                *(
                    None if left_out >> i & 1 else add.bind(rows, y=y, AMOUNT=10**i)
                    for i in range(3)
                )
            )
            assert set(y.numpy()) == {0, sum(10**i for i in range(3) if not left_out >> i & 1)}


@pytest.mark.parametrize("planes", [1, 3, 4, 5])
def test_a_fused_kernel_visits_a_coarse_plane_once(add, row_pass, planes):
    """Wave that visits each coarse plane once.

    The last stage is so far behind that the wave continues after the last fine plane.
    """
    count = row_pass("count", EACH + "c[k] += x[2*k];", writes={"c": "S"}, other={"x": "S"})
    fine, coarse = (
        Rows.of(Padding(counts), CPU) for counts in ((planes, 4, 4), ((planes + 1) // 2, 2, 2))
    )
    x, y, c = zeros(fine.size), zeros(fine.size), zeros(coarse.size)
    passes = (
        add.bind(fine, y=x),
        count.bind(coarse.beside(fine, (2, 2, 2)), c=c, x=x),
        add.bind(fine, y=y),
    )
    FusedKernel("test_misuse.coarse", (add, 0), (count, 1), (add, 4)).launch(*passes)
    assert (
        c.numpy().reshape(-1, 4, 4)[1:-1, 1:-1, 1:-1] == 1
    ).all() and y.numpy().sum() == planes * 16


@pytest.mark.cpu_form("waves are the CPU's")
def test_kernels_that_cannot_be_fused_are_refused(add):
    for stages in ((), ((add, 0),) * 5, ((add, 1), (add, 0)), ((add, 0), (add, -1))):
        with pytest.raises(ValueError, match=r"misuse\.wrong: expected 1 to 4 passes"):
            FusedKernel("test_misuse.wrong", *stages)
    with pytest.raises(ValueError, match=r"misuse\.flat: takes whole rows"):
        FusedKernel("test_misuse.flat", (add, 0)).launch(
            add.bind(Rows.flat(20_000, CPU), y=zeros(20_000))
        )


def test_a_recorded_sequence_keeps_its_memory(double):
    rows, y, program = Rows.flat(1000, CPU), zeros(1000), CommandBuffer(CPU)
    arrays = [array(np.full(1000, 3.0))]
    stages, kept = [double.bind(rows, x=arrays[0], y=y)], weakref.ref(arrays[0])
    PersistentKernel("test_misuse.kept", stages).launch(program.launch)
    stages.clear()
    arrays.clear()
    gc.collect()
    assert kept() is not None
    program.run()
    assert (y.numpy() == 6).all()
    with pytest.raises(ValueError, match=r"misuse\.none: takes passes, all on one device"):
        PersistentKernel("test_misuse.none", [])
