# mypy: ignore-errors
"""Kernel variants: C++ source and Warp kernel of a declaration with fixed types.

The constants are fixed as well.
"""

import ctypes
import functools
import math
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, SupportsIndex, TypeAlias

import warp as wp

from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.header_text import shared, text
from warp_lcp.kernels.layout import (
    ANYWHERE,
    Alignment,
    BoundFields,
    BoundOperands,
    KernelStencil,
    Pattern,
    RowLayout,
    make_struct,
    native_of,
    packed,
    stencil_struct,
    threads,
)
from warp_lcp.kernels.recorded_arguments import KernelArgument, value_of
from warp_lcp.kernels.thread_pool import TableEntry
from warp_lcp.kernels.types import DataType, FieldType, StructInstance

if TYPE_CHECKING:
    from warp_lcp.kernels.stencil_kernel import BoundKernel, StencilKernel

Letters: TypeAlias = tuple[tuple[str, DataType], ...]  # with the type of each
Resolver: TypeAlias = Callable[[FieldType], DataType]  # the type that a letter stands for
C_TYPES = {wp.uint8: "unsigned char", wp.float32: "float", wp.float64: "double"}
C = {**C_TYPES, wp.int8: "signed char", wp.int32: "int", wp.bool: "bool"}
# Types of fields that quads keep in registers.
LOADED = (wp.uint8, wp.int8, wp.int32, wp.float32, wp.float64)
POINTERS = "const auto in_ = [](auto* q, auto first) { return q + first; };"
# Alignments of the fields of quad kernels, and of those of the other level.
Quads = tuple[Alignment, Alignment]
QUADS = ANYWHERE, ANYWHERE
# Threads of a block, and blocks that fit on a multiprocessor: a thread has 128 registers at most.
BLOCKS_OF_QUADS = 256, 2
PLACE = ("k0", "j0", "i0")  # first stored cell of a box
INTEGERS = {wp.int32: "i", int: "i", wp.int64: "q", wp.bool: "?", bool: "?"}
PACKED = {wp.float32: "f", wp.float64: "d", **INTEGERS}  # numbers, as formats of `struct`
SIDES = struct.Struct("dd")  # the two numbers that end the struct of bounds
# Bounds that are the same everywhere, infinite ones too; else "coded", "fields".
NUMBERS = "numbers"
# Stencils: with one weight an axis, with arrays of weights, or with a product in their place.
UNIFORM, VARIABLE, KNOWN = "uniform", "variable", "known"


def words_of(quads: Quads | None) -> list[str]:
    """Return the key of variants by quads, to tell them apart."""
    if quads is None:
        return []
    return [
        "quads",
        *(f"{name}{a.word}" for name, a in zip(("at", "of"), quads, strict=True) if a.word),
    ]


@functools.cache
def form_of(
    declared: "StencilKernel",
    letters: Letters,
    constants: tuple[tuple[str, float], ...],
    shape: str | Pattern,
    bounds: str,
    *,
    quads: Quads | None = None,
) -> "KernelVariant":
    """Return the variant with these types, constants, stencil and bounds.

    `quads`: a thread takes four cells.
    """
    return KernelVariant(declared, dict(letters), dict(constants), shape, bounds, quads=quads)


TOGETHER: dict[
    str, list["StencilKernel"]
] = {}  # declarations by the Warp module in which they are compiled


def make_kernels_of_module(
    form: "KernelVariant", letters: Letters, shape: str | Pattern, bounds: str
) -> None:
    """Create all kernels of a variant's module before Warp loads it.

    If a kernel were added later, Warp would compile all of them again.
    """
    if not form.declared.module or form.pattern is not None:
        return
    for other in TOGETHER[form.declared.module]:
        words = other.words(dict(letters), other.constants, shape, bounds) + words_of(form.quads)
        if (
            other.letters == form.declared.letters
            and words == form.words
            and (other.quads or not form.quads)
        ):
            assert form_of(
                other, letters, tuple(other.constants.items()), shape, bounds, quads=form.quads
            ).kernel


class KernelVariant:
    """A stencil kernel whose types and constants are known.

    Attributes:
        words: the variant's key.
        joins: whether it is compiled with other kernels.
        quads: alignments, where a thread takes four cells of a row at a time, on CUDA only; see
            `headers/quad.h`. None: a thread takes single cells.
        name: of its kernel.
        fields: struct of its arguments.
        native: that struct in C.
        run: native function (layout, fields, slab, row, chunk of the first task, number of tasks).
    """

    def __init__(
        self,
        declared: "StencilKernel",
        letters: dict[str, DataType],
        constants: dict[str, float],
        shape: str | Pattern,
        bounds: str,
        *,
        quads: Quads | None = None,
    ) -> None:
        self.declared, self.letters, self.bounds, self.quads, d = (
            declared,
            letters,
            bounds,
            quads,
            declared,
        )
        self._chosen = tuple(sorted(letters.items())), tuple(constants.items()), shape, bounds
        self.pattern = pattern = shape if isinstance(shape, Pattern) else None
        self.joins = bool(d.module) and pattern is None  # shares a module with other kernels
        shape = pattern.word if pattern else shape
        type_of = lambda kind: letters[kind] if isinstance(kind, str) else kind  # noqa: E731
        self.words = d.words(letters, constants, shape, bounds) + words_of(quads)
        weights = (
            type_of(d.stencil[1])
            if d.stencil and (shape == VARIABLE or (pattern and pattern.names))
            else wp.float32
        )
        parts = (
            {"stencil": stencil_struct(type_of(d.stencil[0]), weights, pattern)}
            if d.stencil
            else {}
        )
        parts |= {"bounds": BoundFields} if d.bounds else {}
        self.types = {name: type_of(kind) for name, kind in d.arrays.items()}
        members = {n: wp.array(dtype=t) for n, t in self.types.items()} | {
            n: type_of(t) for n, t in d.numbers.items()
        }
        self._numbers = struct.Struct("".join(PACKED[type_of(t)] for t in d.numbers.values()))
        self.fields = Fields = make_struct(
            f"{d.name.replace('.', '_')}_{'_'.join(self.words)}", parts | members
        )

        def run(L: RowLayout, given: Fields, slab_: int, row_: int, chunk_: int, count_: int): ...

        blank = Fields()
        self._struct, self.native, self._entry = type(blank), type(native_of(blank)), None
        self._size = ctypes.sizeof(self.native)
        area, _, last = d.name.rpartition(".")
        variant = ".".join(
            ["warp_lcp", *([d.module] if self.joins else d.name.split(".")), "_".join(self.words)]
        )
        # A module name of its own: Warp would take other variants for overloads.
        run.__module__ = area if d.box else variant
        self.name = d.name.replace(".", "_") if self.joins else last
        run.__qualname__ = f"{self.name}_rows"
        self._code = self._source(letters, constants, ord(shape[0]), type_of)
        self.run = wp.func_native(self._code)(run)

    def _source(
        self,
        letters: dict[str, DataType],
        constants: dict[str, float],
        stencil: int,
        type_of: Resolver,
    ) -> str:
        """Return the kernel's body in C++.

        It is a loop over pieces with pointers by name, the shared functions, the row function and
        the sums.
        """
        d, pattern = self.declared, self.pattern
        assert not (self.quads and (pattern or not d.quads)), d.label
        into = not {*d.ring}.isdisjoint(d.writes)
        levels = d.finer or bool(d.other)
        switches = {"RINGS": bool(d.ring), "INTO_RING": into, "LEVELS": levels, "BOX": bool(d.box)}
        switches |= {
            "BOUNDS": ord(self.bounds[0]),
            "STENCIL": stencil,
            "FOUND": len(d.reductions),
            "SUMS": len(d.sums),
        }
        macros = {n: v for n, v in constants.items() if isinstance(v, SupportsIndex)}
        head = [f"typedef {C[t]} {n};" for n, t in letters.items()] + [
            f"typedef {C[type_of(d.compute)]} T;"
        ] * ("T" not in letters)
        head += [f"constexpr int {n} = {int(v)};" for n, v in switches.items()] + [
            f"#define {n} {int(v)}" for n, v in macros.items()
        ]
        head += [
            f"constexpr double {n} = {float(v)!r};" for n, v in constants.items() if n not in macros
        ]
        if self.quads:
            return self._source_of_quads(head, macros, type_of)
        at = {
            n: " + p + P.ring" if n in d.ring else " + p" for n in (*d.reads, *d.writes)
        } | dict.fromkeys(d.other, " + P.q")
        each = [
            "const Piece P = piece(k_i, j_i, c_, ring_); const int n = P.n; const long long p = "
            "P.p;"
        ]
        each += [
            f"const long long yp = {'L.o2' if d.finer else 'P.yp'}, zp = "
            f"{'L.o1' if d.finer else 'P.zp'};"
        ]
        each += [
            f"const long long ym = {'-yp' if d.finer else 'P.ym'}, zm = "
            f"{'-zp' if d.finer else 'P.zm'};"
        ]
        each += [
            "const long long down = P.down, up = P.up;"
            if d.ring and not into
            else "const long long down = zm, up = zp;"
        ]
        if levels:
            each += [
                "const bool pairs = L.fx > 1 || L.fx < -1; const int deep = L.fz == 1 || 2*P.k + 2 "
                "> L.n1 ? 1 : 2;"
            ]
            each += ["const int wide = L.fy == 1 || 2*P.j + 2 > L.n2 ? 1 : 2;"]
        for n in (n for n in d.arrays if n not in d.box and not (d.reductions and n == "out")):
            pointer = f"given.{n}.data{at.get(n, '')}"
            pointer = f"given.{n}.data ? {pointer} : nullptr" if n in d.optional else pointer
            each += [f"{'const ' * (n in d.reads)}auto* {n} = {pointer};"]
        each += [f"const auto {n} = given.{n};" for n in d.numbers]
        if d.box:
            each += [f"double {n} = 0;" for n in d.reductions]
            each += [
                f"const long long s2 = given.{next(iter(d.box))}.shape[2], s1 = "
                f"s2*given.{next(iter(d.box))}.shape[1];"
            ]
            listed = [
                f"for (int m_ = P.first; m_ < P.first + n; ++m_) {{ const int at_ = "
                f"{d.listed}[m_], k = at_ / (int)s1;"
            ]
            listed += [
                "const int j = (at_ - k*(int)s1) / (int)s2, first = at_ % (int)s2, last = first + "
                "1;"
            ]
            each += (
                listed
                if d.listed
                else [
                    "const int k = P.k + k0, j = P.j + j0, first = P.first + i0, last = first + n;"
                ]
            )
            each += [
                f"auto* {n} = given.{n}.data ? given.{n}.data + k*s1 + j*s2 : nullptr;"
                for n in d.box
            ]
        if d.stencil:
            fields, numbers = (
                (pattern.names, pattern.numbers)
                if pattern
                else (("wx", "wy", "wz"), ("cx", "cy", "cz"))
            )
            first = "P.q" if d.finer else "p"
            each += [
                f"const auto* {n} = given.stencil.{n}.data + {first};"
                for n in ("d", *fields, "known")
            ]
            each += [f"const T {n} = (T)given.stencil.{n};" for n in ("unit", *numbers)]
            if pattern:
                at = (
                    f"const long long e = k + {first} - {'L.o0' if d.finer else 'L.base'}, a = "
                    "yp, b = zp;"
                )
                each += [
                    f"const auto place = [&](long long k) {{ {at}",
                    "return wp::vec3i((int)(e / b), (int)(e % b / a), (int)(e % a)); };",
                ]
                each += pattern.source()
        sums = [
            "#define EACH_FOUND(DO) "
            f"{' '.join(f'DO({s}, {name})' for s, name in enumerate(d.reductions))}",
            shared("piece.h", "sums"),
        ]
        sums += ["#undef EACH_FOUND"]
        common = [
            shared("row_functions.h", section)
            for section, used in (("stencil", d.stencil), ("bounds", d.bounds))
            if used
        ]
        tasks = [
            shared("piece.h", "piece"),
            shared("piece.h", "tasks"),
            '#line 1 "fields"',
            POINTERS,
            *each,
        ]
        # In a block of its own, local names may be those of the declaration.
        body = ["{", text(d.header, d.declared), "}"] if d.box else [text(d.header, d.declared)]
        body += ["}"] * bool(d.listed)
        body += ['#line 1 "sums"', *(sums if d.reductions else []), '#line 1 "end"', "}}}"]
        body = [*tasks, *common, *body]
        if d.box and not (d.listed or d.stencil or d.bounds):
            body = ["#ifdef __CUDA_ARCH__", *self._tasks_of_box(sums), "#else", *body, "#endif"]
        macros |= {"EACH_WEIGHT": 0} if pattern and d.stencil else {}
        before = [shared("native.h"), '#line 1 "types"', *head]
        return "\n".join(["", *before, *body, *(f"#undef {n}" for n in macros), ""])

    def _tasks_of_box(self, sums: list[str]) -> list[str]:
        """Return C++ of a thread's task over a box on CUDA.

        The row function is there twice: for one cell, and for any number of cells.
        """
        d = self.declared
        box = f"given.{next(iter(d.box))}"
        lines = [f"const long long s2 = {box}.shape[2], s1 = s2*{box}.shape[1];", shared("box.h")]
        fields = []
        for n in d.box:
            pointer = f"given.{n}.data + offset_"
            pointer = f"given.{n}.data ? {pointer} : nullptr" if n in d.optional else pointer
            fields.append(f"auto* {n} = {pointer};")
        whole = [n for n in d.arrays if n not in d.box and not (d.reductions and n == "out")]
        fields += [f"auto* {n} = given.{n}.data;" for n in whole]
        fields += [f"const auto {n} = given.{n};" for n in d.numbers if n not in PLACE]
        fields += [f"double {n} = 0;" for n in d.reductions]
        function = ['#line 1 "fields"', *fields, "{", text(d.header, d.declared), "}"]
        function += ['#line 1 "sums"', *(sums if d.reductions else []), '#line 1 "end"', "}"]
        planes = ["long long offset_ = corner_; int at_ = begin_ * L.rows + row_;"]
        planes += ["for (int k_i = begin_; k_i < end_; ++k_i, at_ += L.rows, offset_ += s1) {"]
        planes += ["const Piece P = {n, k_i + plane_, j_, from_, at_, place_, k_i > begin_};"]
        planes += ["const int k = P.k + k0, last = first + n;"]
        one = ["if (L.grain == 1 && !L.pieces.data) {", "constexpr int n = 1;"]
        rest = ["} else {", "const int n = to_ > from_ ? to_ - from_ : 0;"]
        return [*lines, *one, *planes, *function, *rest, *planes, *function, "}"]

    def _source_of_quads(self, head: list[str], macros: dict[str, float], type_of: Resolver) -> str:
        """Return the kernel's body for quads in C++.

        It is a loop over planes with the row function twice: for four cells and for fewer.
        """
        d = self.declared
        found = " ".join(f"DO({s}, {name})" for s, name in enumerate(d.reductions))
        sums = (
            [f"#define EACH_FOUND(DO) {found}", shared("piece.h", "sums"), "#undef EACH_FOUND"]
            if d.reductions
            else []
        )
        common = [
            shared("row_functions.h", section)
            for section, used in (("stencil", d.stencil), ("bounds", d.bounds))
            if used
        ]
        function = [*common, text(d.header, d.declared), '#line 1 "sums"', *sums]
        head = [*head, f"constexpr bool FINER = {str(d.finer).lower()};"]
        for level, at in zip(("Ours_", "Others_"), self.quads, strict=True):
            head.append(
                f"struct {level} {{ enum {{ FIRST = {at.first}, EITHER = {int(at.either)} }}; }};"
            )
        before = [
            "#define QUADS",
            shared("native.h"),
            '#line 1 "types"',
            *head,
            shared("quad.h"),
            '#line 1 "fields"',
        ]
        whole = [
            line
            for half in self._halves()
            for line in (
                *half,
                *self._fields_of_quad(type_of, in_registers=True),
                *function,
                "}",
                "else",
            )
        ][:-1]
        rest = [
            "else if (FOUND || P.n > 0) {",
            "const int n = P.n;",
            POINTERS,
            *self._fields_of_quad(type_of, in_registers=False),
            *function,
            "}",
        ]
        # Groups of fewer than four cells: their loops are not unrolled.
        once = ["#undef VECTORS", '#define VECTORS(WIDTH) _Pragma("unroll 1")']
        after = [
            '#line 1 "end"',
            "}",
            "#undef QUADS",
            "#undef METHOD",
            *(f"#undef {n}" for n in macros),
            "",
        ]
        return "\n".join(["", *before, *whole, *once, *rest, *after])

    def _halves(self) -> list[list[str]]:
        """Return C++ that begins the row function for whole quads.

        It is there once for each alignment of rows.
        """
        finer = self.declared.finer
        either = self.quads[finer].either
        halves = []
        for half in ("false", "true")[: 1 + either]:
            ours, others = ("half_", half) if finer else (half, "other_half_")
            here = f" && {'other_' * finer}half_ == {half}" * either
            lines = [f"if (P.n == 4{here}) {{", "constexpr int n = 4;"]
            lines += [
                f"const auto in_ = reading_(Ours_(), {ours});",
                f"const auto in_other_ = reading_(Others_(), {others});",
            ]
            halves.append([*lines, f"const auto out_ = writing_({ours});"])
        return halves

    def _fields_of_quad(self, type_of: Resolver, *, in_registers: bool) -> list[str]:
        """Return C++ that declares the fields at a quad's first cell, by name.

        `in_registers`: hold them in registers, as `quad.h` does.
        """
        d = self.declared
        declarations = []
        of_other = "in_other_" if in_registers else "in_"
        reading = lambda other, data: f"{of_other}({data}, q)" if other else f"in_({data}, p)"  # noqa: E731
        for n in (n for n in d.arrays if not (d.reductions and n == "out")):
            if (
                in_registers
                and self.types[n] in LOADED
                and (n in d.reads or n in d.writes or (d.finer and n in d.other))
            ):
                data = f"given.{n}.data"
                out = f"auto {n} = out_({data}, p);"
                declarations.append(
                    out if n in d.writes else f"const auto {n} = {reading(n in d.other, data)};"
                )
                continue
            pointer = f"given.{n}.data" + (
                " + p" if n in d.reads or n in d.writes else " + q" * (n in d.other)
            )
            pointer = f"given.{n}.data ? {pointer} : nullptr" if n in d.optional else pointer
            declarations.append(f"{'const ' * (n in d.reads)}auto* {n} = {pointer};")
        declarations += ["const bool pairs = L.fx > 1 || L.fx < -1;"] if d.other or d.finer else []
        declarations += (
            [
                "const int deep = L.fz == 1 || 2*P.k + 2 > L.n1 ? 1 : 2, wide = L.fy == 1 || 2*P.j "
                "+ 2 > L.n2 ? 1 : 2;"
            ]
            if d.finer
            else []
        )
        declarations += [f"const auto {n} = given.{n};" for n in d.numbers]
        if d.stencil:
            fields, numbers = ("d", "wx", "wy", "wz", "known"), ("unit", "cx", "cy", "cz")
            declarations += [
                f"const auto {n} = {reading(d.finer, f'given.stencil.{n}.data')};" for n in fields
            ]
            declarations += [f"const T {n} = (T)given.stencil.{n};" for n in numbers]
        return declarations

    def fill(
        self,
        stencil: KernelStencil | None,
        bounds: BoundOperands | None,
        kernel_args: dict[str, KernelArgument],
    ) -> bytes:
        """Return the C layout of the argument struct.

        Structs and arrays come first, side by side, as they fill whole eight bytes; then numbers.
        """
        parts = [] if stencil is None else [native_of(stencil.struct)]
        if bounds is not None:
            lower, least, upper, most, code = bounds
            parts += [*packed((lower, upper, code)), SIDES.pack(least.value, most.value)]
        parts += packed([kernel_args[name] for name in self.types])
        values = [value_of(kernel_args[name]) for name in self.declared.numbers]
        try:
            parts.append(self._numbers.pack(*values))
        except struct.error as error:
            named = zip(self.declared.numbers, values, strict=True)
            raise TypeError(
                f"{self.declared.label}: {', '.join(f'{n} = {v!r}' for n, v in named)}: {error}"
            ) from None
        return b"".join(parts).ljust(self._size, b"\0")

    def struct_of(self, bound: "BoundKernel") -> StructInstance:
        """Return the argument struct for Warp, which keeps the arrays alive.

        A capture on the CPU finds the arrays in it by name.
        """
        stencil, bounds = bound.keep_alive
        members = {name: bound.kernel_args[name] for name in self.types}
        if stencil is not None:
            members["stencil"] = stencil.struct
        if bounds is not None:
            members["bounds"] = SimpleNamespace(lower=bounds[0], upper=bounds[2], code=bounds[4])
        made = object.__new__(self._struct)
        made.__dict__.update(
            members, _kept=bound, _ctype=self.native.from_buffer_copy(bound.arguments)
        )
        return made

    @functools.cached_property
    def run_in_turn(self) -> wp.Function:
        """`run` for launches of several kernels, which read each other's results.

        `__ldg` is not used: its loads may return values from before the launch.
        """
        if not self.quads:
            return self.run

        def run(
            L: RowLayout, given: self.fields, slab_: int, row_: int, chunk_: int, count_: int
        ): ...

        run.__module__ = self.run.module.name
        run.__qualname__ = f"{self.name}_rows_in_turn"
        code = f"#define __ldg(q) (*(q))\n{self._code}\n#undef __ldg\n"
        return wp.func_native(code)(run)

    @functools.cached_property
    def kernel(self) -> wp.Kernel:
        """The kernel of a launch by itself."""
        run, Fields, touch = self.run, self.fields, self.pattern.touch if self.pattern else None
        if self.quads:

            def alone(L: RowLayout, F: Fields):
                q = task_of(L, wp.tid())
                run(L, F, q[0], q[1], q[2], 1)
        elif touch is not None:

            def alone(L: RowLayout, F: Fields):
                i, j, c = wp.tid()
                if L.planes < 0:
                    touch(0)
                first = first_task(L)
                run(L, F, i + first[0], j + first[1], c + first[2], wp.max(L.end - L.begin, 1))
        elif self.declared.box:

            def alone(L: RowLayout, F: Fields):
                i, j, c = wp.tid()
                first = first_task(L)
                q = task_of_box(L, i + first[0], j + first[1], c + first[2])
                run(L, F, q[0], q[1], q[2], wp.max(L.end - L.begin, 1))
        else:

            def alone(L: RowLayout, F: Fields):
                i, j, c = wp.tid()
                first = first_task(L)
                run(L, F, i + first[0], j + first[1], c + first[2], wp.max(L.end - L.begin, 1))

        alone.__name__ = alone.__qualname__ = self.name
        if self.quads:
            return forward_kernel(module=run.module.name, launch_bounds=BLOCKS_OF_QUADS)(alone)
        # The caller's function may need features that the project's flags leave out.
        if touch is not None:
            return wp.kernel(enable_backward=False, module=run.module.name)(alone)
        return forward_kernel(module=run.module.name)(alone)

    @property
    def by_cells(self) -> "KernelVariant":
        """The same variant by single cells."""
        return form_of(self.declared, *self._chosen)

    @property
    def by_quads(self) -> "KernelVariant | None":
        """The same variant by quads, as CUDA launches it on grids; None if impossible."""
        return self.with_quads(QUADS)

    def with_quads(self, quads: Quads) -> "KernelVariant | None":
        """Return the same variant by quads at these alignments; None if impossible."""
        if not self.declared.quads or self.pattern is not None:
            return None
        return form_of(self.declared, *self._chosen, quads=quads)

    def dim(self, layout: RowLayout) -> tuple[int, ...]:
        """Return the dimensions of a launch of the kernel.

        Quads use one dimension, because three would be divided in 64 bits.
        """
        return (math.prod(threads(layout)),) if self.quads else threads(layout)

    def entry(self, bound: "BoundKernel") -> TableEntry:
        """Return the kernel in the form of the thread pool."""
        if self._entry is None:
            self._entry = TableEntry(
                wp.launch(
                    self.kernel,
                    (1, 1, 1),
                    [bound.layout, bound.fields],
                    device="cpu",
                    record_cmd=True,
                )
            )
        return self._entry


@wp.func_native("""
#ifdef __CUDA_ARCH__
return wp::vec3i(0, 0, 0);
#else
return wp::vec3i(L.begin / (L.rows*L.chunks), L.begin / L.chunks % L.rows, L.begin % L.chunks);
#endif
""")
def first_task(L: RowLayout) -> wp.vec3i:
    """Compute slab, row and chunk of a range's first task.

    They are 0 on CUDA, where a thread has a task of its own.
    """


@wp.func_native("""
#ifdef __CUDACC__
const unsigned t = blockIdx.x*blockDim.x + threadIdx.x, line = t / (unsigned)L.chunks;
slab = (int)(line / (unsigned)L.rows);
return wp::vec3i(slab, (int)(line - slab*L.rows), (int)(t - line*L.chunks));
#else
return wp::vec3i(slab, row, chunk);
#endif
""")
def task_of_box(L: RowLayout, slab: int, row: int, chunk: int) -> wp.vec3i:
    """Return slab, row and chunk of a thread of a launch over a box.

    On CUDA they are computed from the number of the thread, because Warp divides it in 64 bits. A
    launch has a thread for each task, and less than 2^32 threads.
    """


@wp.func_native("""
const unsigned t = (unsigned)thread, row = t / (unsigned)L.chunks, slab = row / (unsigned)L.rows;
return wp::vec3i((int)slab, (int)(row - slab*L.rows), (int)(t - row*L.chunks));
""")
def task_of(L: RowLayout, thread: int) -> wp.vec3i:
    """Compute slab, row and chunk of a thread in a launch with one dimension."""
