"""Declarations of kernels in headers: results, errors, and use in Python."""

import re
from pathlib import Path

import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.header_text import HEADERS, sections, text

ROOT = Path(wl.__file__).parent
EVERY = """// Kernels of a test.

// snippet twice: two times a value
const auto twice = [](T v) { return 2*v; };

// kernel mine.every: a description
// that goes on: in a second line
//   compute    S
//   stencil    D, W
//   bounds
//   reads      S x, b?; int8 unknown
//   writes     float64 y,
//              z?
//   ring       y
//   other      S coarse
//   finer
//   by_row     uint8 changed
//   whole      vec3 turn; int32 cells
//   numbers    int count; bool kept; S omega; int64 step
//   sums       first, second
//   largest    most
//   constants  SIZE, ROUNDED = 0, SHARE = 0.5, LOW = -2
//   ordered
// of the body
#include "twice"
T first = 0, second = 0, most = 0;

// kernel mine.list.box: cells of a list
//   compute    float32 | float64
//   box        T field, of?; vec3<T> position
//   whole      int32 cells
//   listed     cells
//   numbers    T scale
#include "mine.every"
field[first] = scale;
"""


@pytest.fixture
def header(tmp_path):
    def written(source, name="area"):
        (tmp_path / f"{name}.h").write_text(source)
        return tmp_path / f"{name}.h"

    return written


def test_a_declaration_has_every_role(header):
    every = KernelFile(header(EVERY), {"SIZE": 3, "OF_ANOTHER_FILE": 1}).kernel(
        "mine.every", constants={"ROUNDED": 1}
    )
    assert (every.name, every.compute, every.stencil) == ("mine.every", "S", ("D", "W"))
    assert every.reads == {"x": "S", "b": "S", "unknown": wp.int8}
    assert every.writes == {"y": wp.float64, "z": wp.float64}
    assert (every.other, every.by_row) == ({"coarse": "S"}, {"changed": wp.uint8})
    assert every.whole == {"turn": wp.vec3, "cells": wp.int32}
    assert every.numbers == {"count": int, "kept": bool, "omega": "S", "step": wp.int64}
    assert (every.optional, every.ring, every.sums, every.largest) == (
        ("b", "z"),
        ("y",),
        ("first", "second"),
        ("most",),
    )
    assert (every.bounds, every.finer, every.ordered, every.box, every.listed) == (
        True,
        True,
        True,
        {},
        "",
    )
    assert every.constants == {"SIZE": 3, "ROUNDED": 1, "SHARE": 0.5, "LOW": -2}
    assert every.source == f"{every.header}:6"


def test_kernels_of_a_module_are_compiled_together_for_the_same_types(header):
    kernel = """// kernel mine.{name}: a copy
//   compute    S
//   reads      {kind} x
//   writes     S y
//   module     mine
for (int k = 0; k < n; ++k) y[k] = ({factor})*x[k];

"""
    names = {"first": "S", "second": "S", "other": "R"}
    source = "".join(
        kernel.format(name=n, kind=kind, factor=f + 1) for f, (n, kind) in enumerate(names.items())
    )
    kernels = KernelFile(header(source))
    first, second, other = (kernels[f"mine.{name}"] for name in names)
    rows, device = Rows.flat(4, wp.get_device("cpu")), "cpu"
    x, y, z = (
        wp.array([1, 2, 3, 4], dtype=wp.int32, device=device),
        *(wp.zeros(4, dtype=wp.int32, device=device) for _ in range(2)),
    )
    a = first.bind(rows, x=x, y=y)
    # Before either is launched.
    assert sorted(a.form.run.module.kernels) == ["mine_first", "mine_second"]
    b = second.bind(rows, x=x, y=z)
    assert b.form.run.module is a.form.run.module
    assert other.bind(rows, x=x, y=y).form.run.module is not a.form.run.module
    a.launch()
    b.launch()
    assert y.numpy().tolist() == [1, 2, 3, 4]
    assert z.numpy().tolist() == [2, 4, 6, 8]


@pytest.mark.parametrize(("real", "vector"), [(wp.float32, wp.vec3), (wp.float64, wp.vec3d)])
def test_a_variant_has_a_type_and_a_module(header, real, vector):
    box = KernelFile(header(EVERY)).kernel(
        "mine.list.box", module=f"test_variants.{real.__name__}", compute=real
    )
    assert (box.name, box.compute) == (f"test_variants.{real.__name__}.box", real)
    assert (box.box, box.optional, box.listed) == (
        {"field": real, "of": real, "position": vector},
        ("of",),
        "cells",
    )
    assert box.numbers["scale"] is real
    assert (box.bounds, box.stencil, box.ordered) == (False, None, False)


def test_errors_of_the_compiler_name_the_line_in_the_header(header):
    path = header(EVERY)
    lines, source = text(path, "mine.list.box").splitlines(), path.read_text().splitlines()
    number, seen = 0, list[str]()
    for line in lines:  # the text of a line is that of the header
        if found := re.fullmatch(r'#line (\d+) "area.h"', line):
            number = int(found[1])
            continue
        assert source[number - 1] == line
        number, seen = number + 1, [*seen, line]
    code = [line for line in seen if line and not line.startswith("//")]
    assert code == [
        "const auto twice = [](T v) { return 2*v; };",
        "T first = 0, second = 0, most = 0;",
        "field[first] = scale;",
    ]


def test_snippets_come_from_another_file(header):
    header("// Snippets.\n\n// snippet ten: a number\nconst int ten = 10;\n", "others")
    fill = KernelFile(
        header(
            "// kernel mine.fill: ten\n//   compute    S\n//   writes     S x\n#include "
            '"others.h:ten"\nx[0] = ten;\n'
        )
    )
    x = wp.zeros(1, dtype=wp.float32, device="cpu")
    fill["mine.fill"].bind(Rows.flat(1, x.device), x=x).launch()
    assert x.numpy() == [10]


KERNEL = "// kernel mine.k: what it does\n//   compute    S\n"
WRONG = {
    "an unknown role": (KERNEL + "//   read       S x\ny;\n", 3, "'read' is not a role"),
    "a role twice": (
        KERNEL + "//   reads      S x\n//   reads      S y\ny;\n",
        4,
        "reads stands twice",
    ),
    "a flag with names": (KERNEL + "//   bounds     x\ny;\n", 3, "bounds takes nothing"),
    "a role without names": (KERNEL + "//   reads\ny;\n", 3, "reads takes names"),
    "an unknown type": (KERNEL + "//   reads      flot x\ny;\n", 3, "the type 'flot'"),
    "no type": (KERNEL + "//   reads      x\ny;\n", 3, "the type 'x'"),
    "a name twice": (KERNEL + "//   reads      S x, x\ny;\n", 3, "has 'x'"),
    "an optional number": (KERNEL + "//   numbers    S x?\ny;\n", 3, "has 'x?'"),
    "no name": (KERNEL + "//   sums       a b\ny;\n", 3, "'a b', which is not a name"),
    "a wrong constant": (KERNEL + "//   constants  A = B\ny;\n", 3, "'A = B'"),
    "one weight": (
        KERNEL + "//   stencil    D\ny;\n",
        3,
        "the types of the diagonal and of the weights",
    ),
    "a list of none": (
        KERNEL + "//   box        S x\n//   listed     y\ny;\n",
        4,
        "no int32 array",
    ),
    "no compute": (
        "// kernel mine.k: what it does\n//   reads      S x\ny;\n",
        1,
        "compute needs a type",
    ),
    "no body": (KERNEL + "// a comment\n\n", 1, "mine.k has no body"),
    "no description": ("// kernel mine.k\n//   compute    S\ny;\n", 1, "NAME: description"),
    "a kernel twice": (KERNEL + "y;\n\n" + KERNEL + "y;\n", 5, "mine.k is declared in line 1, too"),
    "code before the first": ("int x;\n" + KERNEL + "y;\n", 1, "expected comments"),
}


@pytest.mark.parametrize("what", WRONG)
def test_errors_name_file_and_line(header, what):
    source, line, why = WRONG[what]
    path = header(source)
    with pytest.raises(ValueError, match=re.escape(f"{path}:{line}: ") + ".*" + re.escape(why)):
        KernelFile(path)


def test_wrong_names_are_refused(header):
    kernels = KernelFile(header(EVERY))
    with pytest.raises(ValueError, match=r"no kernel mine.evry, but mine.every, mine.list.box"):
        assert kernels["mine.evry"]
    with pytest.raises(
        ValueError, match=r"area.h:6: mine.every: Python gives no value for the constants SIZE"
    ):
        assert kernels["mine.every"]
    with pytest.raises(ValueError, match=r"area.h: no kernel declares the constants SIZES"):
        kernels.kernel("mine.every", constants={"SIZES": 3})
    with pytest.raises(ValueError, match=r"mine.list.box: compute is one of float32, float64"):
        kernels.kernel("mine.list.box", compute=wp.int8)
    with pytest.raises(ValueError, match=r"area.h:4: #include \"none\": there is no such"):
        text(header(KERNEL + '//   writes     S x\n#include "none"\nx;\n'), "mine.k")


def test_errors_of_arguments_name_the_declaration(header):
    kernel = KernelFile(header(KERNEL + "//   writes     S x\nx[0] = 1;\n"))["mine.k"]
    with pytest.raises(TypeError, match=rf"mine.k \({re.escape(kernel.source)}\): missing \['x'\]"):
        kernel.bind(Rows.flat(1, wp.get_device("cpu")))
    with pytest.raises(ValueError, match=r"mine.k \(.*own.h:1\): \['n'\]"):
        assert KernelFile(header(KERNEL + "//   writes     S n\nn;\n", "own"))["mine.k"]


PACKAGES = [
    p.resolve()
    for p in ROOT.iterdir()
    if p.is_dir() and p.name not in ("benchmarks", "gallery", "__pycache__")
]
SOURCES = {path: path.read_text() for package in PACKAGES for path in package.rglob("*.py")}
HEADER_FILES = [path for package in PACKAGES for path in package.rglob("*.h")]


def opened(module: Path) -> list[Path]:
    """Return the headers that a module opens."""
    found = re.findall(r'KernelFile\(\s*Path\(__file__\).parent / "([\w/]+\.h)"', SOURCES[module])
    return [module.parent / name for name in found]


def test_every_kernel_and_snippet_is_taken():
    """Use of every kernel and snippet by Python.

    By its name, or the last word of it, as families compose names; `test_cuda_compiles.py` takes
    all of them.
    """
    users = {header for source in SOURCES for header in opened(source)}
    assert len(users) > 35
    headers = [path for path in HEADER_FILES if path.parent != HEADERS] + [
        HEADERS / "vectors.h",
        HEADERS / "snippets.h",
        HEADERS / "row_functions.h",
        HEADERS / "piece.h",
    ]
    words = {
        word
        for path in (*SOURCES, *headers)
        for word in re.findall(r"""["'.:]([\w.]+)["']""", SOURCES.get(path) or path.read_text())
    }
    for header in headers:
        for section in sections(header).values():
            assert {section.name, section.name.rpartition(".")[2]} & words, (
                f"{header}:{section.line}: no Python module uses {section.name}"
            )
            assert section.kind == "snippet" or header in users, header


def test_headers_are_of_areas():
    names = [path.name for path in HEADER_FILES]
    assert len(names) == len(set(names)) <= 50
    for path in HEADER_FILES:
        assert 10 <= len(path.read_text().splitlines()) < 600, path


def test_python_declares_no_roles():
    """Row passes made by `kernel_file.py` alone, so that a kernel stands in one place."""
    for path, source in SOURCES.items():
        assert path.name == "kernel_file.py" or not re.search(
            r"^[^#\n]*\b(?<!class )StencilKernel\(", source, re.MULTILINE
        ), path
