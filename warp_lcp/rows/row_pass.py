# mypy: ignore-errors
"""Row passes: declared by fields with roles and a C++ row function, launched by name, composed to waves.

A row function sees a piece: pointers to its first cell, the number n of its cells, the offsets ym, yp, zm, zp of the rows beside it.
"""

import ctypes
import functools
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from operator import attrgetter, index
from pathlib import Path
from typing import Any, NamedTuple

import warp as wp

from warp_lcp.rows.compiler import forward_kernel
from warp_lcp.rows.layout import BoundFields, Known, Pattern, RowLayout, Rows, copy_of, make_struct, packed, put, stencil_struct, threads
from warp_lcp.rows.memory import ARRAY_BYTES, LAYOUT_BYTES, Scalar, value_of
from warp_lcp.rows.native import HEADERS, sections, shared, text
from warp_lcp.rows.program import Launch, device_program, is_recording, launch_now, perform
from warp_lcp.rows.team import CELLS, SLABS, Entry, Operation, Patch, Stage, get_threads, ranges, team

C_TYPES = {wp.uint8: "unsigned char", wp.float32: "float", wp.float64: "double"}
C = {**C_TYPES, wp.int8: "signed char", wp.int32: "int", wp.bool: "bool"}
PLACE = ("k0", "j0", "i0")  # first stored cell of a box
INTEGERS = {wp.int32: "i", int: "i", wp.int64: "q", wp.bool: "?", bool: "?"}
PACKED = {wp.float32: "f", wp.float64: "d", **INTEGERS}  # numbers, as `struct` calls them
SIDES = struct.Struct("dd")  # the two numbers that end the struct of bounds
LARGEST = 4  # passes of a wave
SLAB_PIECES, SLAB_PLANES = 4, 8  # of waves: their pieces beside each other have work to finish together
NUMBERS = "numbers"  # that are the same everywhere, infinite ones too; else "coded", "fields"
UNIFORM, VARIABLE, KNOWN = "uniform", "variable", "known"  # stencils: with a weight an axis, with arrays of them, with a product in place


# names of the layer's own
OWN = frozenset(("self", "rows", "stencil", "bounds", "given", "P", "n", "p", "ym", "yp", "zm", "zp", "down", "up", "c_", "_ctype"))


@dataclass(frozen=True, eq=False)
class RowPass:
    """What is done to the cells of a row.

    Types of fields are Warp's, or letters: a letter stands for one type, that of the arrays given, and is the name of it in the row
    function. `T` there is the type of computations.

    Args:
        name: of the kernel, with the area before it: `projected_multigrid.assess`.
        header: C++ row function, or the header of an area in which it is `declared`.
        compute: what T stands for.
        stencil: types of the diagonal and the weights of `stencil.h`, if it has one. `affine` there is A x + b: of the stencil, or known.
        bounds: whether it has those of `bounds.h`.
        reads: fields, pointers to the piece's first cell.
        writes: likewise, written.
        ring: which of those keep three planes only; the pointer is to its place there, `down` and `up` lead to the planes around it.
        other: fields of the other level of a transfer, pointers to the element that belongs to the first cell. Cells belong together in
            `pairs` along x or not; `deep` planes and `wide` rows of a finer level belong to one of ours.
        finer: whether the stencil and the offsets are those of the other level, which is finer.
        by_row: one element a row of the grid: pointers to the first row's; `P.row` counts.
        whole: small arrays: pointers to the first element.
        box: fields of all cells of a grid, of `Rows.box`: pointers to the first stored cell of row j of plane k, null where there is none;
            of one that has layers, in its first. The piece is first <= i < last; the planes of the first field are s1 elements apart, its
            rows s2. Such a pass has no letters and one form, in the Warp module that its name begins with. Lists, too, are fields.
        listed: int32 array of `whole` with the flat indices of the cells that are visited; the box is then that of the list's entries.
        optional: which arrays may be None, or empty: their pointers are null then.
        numbers: given by the host.
        sums: variables of the row function that are summed over the cells. Those of a pass over a box are doubles, and 0 before a piece.
        largest: likewise, of which the largest counts; after the sums.
        ordered: whether tasks write what others read or write: on the CPU one thread takes them, in order.
        constants: numbers that are known when the kernel is made, with their usual values; those that are given are integers, and macros.
        declared: the kernel's name in the header, see `kernel_file.py`; empty: the header is the row function alone.
        module: Warp module of passes that are used together. They are compiled at once for each set of types: a module of its own costs
            0.04 s before its first kernel. Not for a pass over a box, whose module its name begins with.

    Raises:
        ValueError: a name cannot be one in C++, is the layer's own, or stands for two things; a role or a letter is of no array.
        TypeError: a number is of a type that cannot be given.
    """

    name: str
    header: Path
    compute: Any
    stencil: tuple[Any, Any] | None = None
    bounds: bool = False
    reads: Mapping[str, Any] = field(default_factory=dict)
    writes: Mapping[str, Any] = field(default_factory=dict)
    ring: tuple[str, ...] = ()
    other: Mapping[str, Any] = field(default_factory=dict)
    finer: bool = False
    by_row: Mapping[str, Any] = field(default_factory=dict)
    whole: Mapping[str, Any] = field(default_factory=dict)
    optional: tuple[str, ...] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)
    sums: tuple[str, ...] = ()
    largest: tuple[str, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict)
    box: Mapping[str, Any] = field(default_factory=dict)
    listed: str = ""
    ordered: bool = False
    declared: str = ""
    module: str = ""

    def __post_init__(self) -> None:
        """Check names, and make the form of a box at once: a Warp module that has been loaded would be compiled again with it."""
        self._check_names()
        if self.module:
            TOGETHER.setdefault(self.module, []).append(self)
        if self.box:
            object.__setattr__(self, "numbers", {**self.numbers, **dict.fromkeys(PLACE, int)})
            assert _form(self, (), tuple(self.constants.items()), UNIFORM, NUMBERS).kernel

    def _check_names(self) -> None:
        """Check the declaration, in whose place a compiler would complain, or nobody."""
        numbers = {n: kind for n, kind in self.numbers.items() if not (self.box and n in PLACE)}
        fields = (self.reads, self.writes, self.other, self.by_row, {**self.whole, **self.box})
        groups = (*fields, numbers, self.constants, self.found and ("out", *(self.found if self.box else ())))
        names = [name for group in groups for name in group]
        wrong = {name for name in names if names.count(name) > 1 or not name.isidentifier() or name in OWN}
        wrong |= {*self.ring} - {*self.reads, *self.writes} | {*self.optional} & {*[*self.box][:1]}
        wrong |= {part for part in self.name.split(".") if not part.isidentifier()}
        known = {*self.arrays.values(), *(self.stencil or ())}
        wrong |= {kind for kind in (self.compute, *numbers.values()) if isinstance(kind, str) and kind not in known}
        if wrong:
            expected = "names that are free, rings of fields, letters of arrays, a first field of a box that is not optional"
            raise ValueError(f"{self.label}: {sorted(wrong)}: expected {expected}")
        if others := {name for name, kind in numbers.items() if not isinstance(kind, str) and kind not in PACKED}:
            raise TypeError(f"{self.label}: {sorted(others)}: expected numbers of the types {', '.join(t.__name__ for t in PACKED)}")

    @functools.cached_property
    def source(self) -> str:
        """File and line of the declaration."""
        return f"{self.header}:{sections(self.header)[self.declared].line if self.declared else 1}"

    @functools.cached_property
    def label(self) -> str:
        """The name and where it is declared, for messages."""
        return f"{self.name} ({self.source})" if self.declared else self.name

    @functools.cached_property
    def letters(self) -> frozenset[str]:
        """Letters that stand for types."""
        return frozenset(kind for kind in (*self.arrays.values(), *(self.stencil or ())) if isinstance(kind, str))

    @functools.cached_property
    def found(self) -> tuple[str, ...]:
        """What is summed, and what the largest is taken of."""
        return (*self.sums, *self.largest)

    @functools.cached_property
    def arrays(self) -> dict[str, Any]:
        """Types of all arrays by name; `out` receives what is found, a column each."""
        out = {"out": wp.float64} if self.found else {}
        return {**self.reads, **self.writes, **self.other, **self.by_row, **self.whole, **self.box, **out}

    def bind(self, rows: Rows, *structs: Any, stencil: Any = None, bounds: list[Any] | None = None, **given: Any) -> "Bound":
        """Check and take what a launch needs.

        Args:
            rows: which rows.
            structs: dataclasses whose members have the names of arguments; the kernel takes those that it declares.
            stencil: a `warp_lcp.operators.padded_stencil.PaddedStencil`, or a `Known` product in place of one.
            bounds: operands of a `warp_lcp.problem.bounds.Bounds`.
            given: arrays, numbers, and constants that are not as usual, by name; they override members of structs.

        Raises:
            TypeError: an argument is missing, unknown, or of the wrong type; two structs have it; a struct is no dataclass.
            ValueError: an array has the wrong length, lies on another device, or its elements do not lie side by side.
        """
        return self.bind_arguments(rows, structs, given, stencil, bounds)

    def bind_arguments(
        self, rows: Rows, structs: tuple[Any, ...], given: dict[str, Any], stencil: Any = None, bounds: list[Any] | None = None
    ) -> "Bound":
        """Bind as `bind` does, for functions that hand on the structs and keywords of their callers; `given` changes."""
        if (self.stencil is None) != (stencil is None) or self.bounds == (bounds is None):
            verb = {True: "needs", False: "takes no"}
            raise TypeError(f"{self.label}: {verb[self.stencil is not None]} stencil, {verb[self.bounds]} bounds")
        if structs:
            given = self._with_members(structs, given)
        if self.box:
            given |= rows.place
            constants = tuple(self.constants.values())
        else:
            try:
                constants = tuple([index(given.pop(n)) if n in given else v for n, v in self.constants.items()]) if self.constants else ()
            except TypeError as error:
                raise TypeError(f"{self.label}: {', '.join(self.constants)} are integers where given: {error}") from None
        if given.keys() != self._wanted:
            missing, unknown = sorted(self._wanted - given.keys()), sorted(given.keys() - self._wanted)
            searched = f" in {', '.join(type(s).__name__ for s in structs)}" if structs and missing else ""
            raise TypeError(f"{self.label}: missing {missing}{searched}, unknown {unknown}")
        types = [getattr(given[n], "dtype", None) for n in self.arrays]
        kind, weights, stored = NUMBERS, None, ()
        if bounds:
            lower, _, upper, _, code = bounds
            if length := code.size or lower.size or upper.size:
                kind = "coded" if code.size else "fields"
                if length != rows.size:
                    raise ValueError(f"{self.label}: bounds have {length} elements, not {rows.size}")
        if stencil is not None:
            d, weights, pattern = stencil.d, stencil.weights, getattr(stencil, "pattern", None)
            stored = (type(stencil), pattern, d.dtype, weights[0].dtype if weights else None)
            if d.size != (rows.other_size if self.finer else rows.size):
                raise ValueError(f"{self.label}: the stencil has {d.size} elements, not {rows.other_size if self.finer else rows.size}")
        key = (constants, kind, *stored, *types)
        made = self._forms.get(key)
        if made is None:
            letters = tuple(sorted(self._letters(stencil, given).items()))
            numbers = tuple(zip(self.constants, constants, strict=True))
            shape = KNOWN if isinstance(stencil, Known) else stored[1] if stencil and stored[1] else VARIABLE if weights else UNIFORM
            made = self._forms[key] = _form(self, letters, numbers, shape, kind)
            _make_kernels_of_module(made, letters, shape, kind)
        self._check_memory(rows, given)
        return Bound(made, rows, made.fill(stencil, bounds, given), given, (stencil, bounds))

    def _with_members(self, structs: tuple[Any, ...], given: dict[str, Any]) -> dict[str, Any]:
        """Return the members of structs that are arguments, and what is given."""
        kinds = tuple([type(s) for s in structs])
        plan = self._members.get(kinds)
        if plan is None:
            plan = self._members[kinds] = self._plan(kinds)
        names, getters = plan
        values = [value for s, get in zip(structs, getters, strict=True) if get is not None for value in get(s)]
        return {**dict(zip(names, values, strict=True)), **given}

    def _plan(self, kinds: tuple[type, ...]) -> tuple[tuple[str, ...], tuple[Any, ...]]:
        """Return the arguments that structs of these classes have, and for each class what gets them, or None."""
        if others := [kind.__name__ for kind in kinds if not is_dataclass(kind)]:
            raise TypeError(f"{self.label}: {others[0]} is not a dataclass")
        shares = [[f.name for f in fields(kind) if f.name in self._wanted] for kind in kinds]
        names = tuple(name for share in shares for name in share)
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise TypeError(f"{self.label}: {', '.join(kind.__name__ for kind in kinds)}: two of them have {twice}")
        return names, tuple(_getter(share) for share in shares)

    def words(self, letters: dict[str, Any], constants: Mapping[str, float], shape: str, bounds: str) -> list[str]:
        """Return what tells a form from others: kinds of stencil and bounds, types, constants that differ from the usual ones."""
        differing = [f"{name.lower()}{value}" for name, value in constants.items() if value != self.constants[name]]
        kinds = [shape] * bool(self.stencil) + [bounds] * (self.bounds and bounds != NUMBERS)
        return [*kinds, *(t.__name__ for _, t in sorted(letters.items())), *differing]

    @functools.cached_property
    def _members(self) -> dict[tuple[type, ...], Any]:
        """Plans of `_with_members` by the classes of structs."""
        return {}

    @functools.cached_property
    def _wanted(self) -> frozenset[str]:
        return frozenset({*self.arrays, *self.numbers})

    @functools.cached_property
    def _forms(self) -> dict[Any, "Form"]:
        """Forms by what is given, so that types are checked once."""
        return {}

    def _letters(self, stencil: Any, given: dict[str, Any]) -> dict[str, Any]:
        """Find what the letters stand for, and check the types of all arrays."""
        letters: dict[str, Any] = {}
        seen: dict[str, str] = {}
        pairs = [(name, kind, given[name]) for name, kind in self.arrays.items()]
        if self.stencil is not None:
            pairs += [("the stencil's d", self.stencil[0], stencil.d)]
            pairs += [("the stencil's weights", self.stencil[1], stencil.weights[0])] if stencil.weights else []
        for name, kind, value in pairs:
            if value is None and name in self.optional:
                continue
            found = value.dtype if isinstance(value, wp.array) else type(value)
            expected = letters.setdefault(kind, found) if isinstance(kind, str) else kind
            if not isinstance(value, wp.array) or found is not expected:
                why = f", as {seen[kind]}" if isinstance(kind, str) and kind in seen else ""
                raise TypeError(f"{self.label}: {name} is {found.__name__}, not an array of {expected.__name__}{why}")
            seen.setdefault(kind, name)
        if others := [f"{seen[kind]} is {found.__name__}" for kind, found in letters.items() if found not in C]:
            raise TypeError(f"{self.label}: {others[0]}: a letter stands for {', '.join(t.__name__ for t in C)}")
        return letters | dict.fromkeys(self.letters - letters.keys(), wp.float32)  # of what is absent

    @functools.cached_property
    def _lengths(self) -> list[tuple[str | None, tuple[str, ...]]]:
        """Names of the arrays of each length, with the attribute of rows that it is; None: of any."""
        sized = (("size", {**self.reads, **self.writes}), ("other_size", self.other), ("count", self.by_row))
        groups = (*sized, (None, {**self.whole, **self.box, **dict.fromkeys(("out",) * bool(self.found))}))
        return [(length, tuple(names)) for length, names in groups if names]

    def _check_memory(self, rows: Rows, given: dict[str, Any]) -> None:
        device = rows.device
        for length, names in self._lengths:
            expected = length and getattr(rows, length)
            for name in names:
                value = given[name]
                found = 0 if value is None else value.size
                if not found and name in self.optional and getattr(value, "slot", None) is None:
                    given[name] = None  # a slice of nothing has an address; of a list that grows it is read when it runs
                if found != expected is not None and (found or name not in self.optional):
                    raise ValueError(f"{self.label}: {name} has {found} elements, not {expected}")
                if found and not (value.is_contiguous and value.device is device):
                    why = f"on {value.device}, not {device}" if value.is_contiguous else "strided"
                    raise ValueError(f"{self.label}: {name} is {why}")
        if self.box:
            self._check_box(rows, {tuple(given[n].shape[-3:]) for n in self.box if given[n] is not None})
        if self.found and given["out"].size < len(self.found) * rows.places:
            least = f"fewer than {len(self.found) * rows.places}: {rows.places} threads for each sum"
            raise ValueError(f"{self.label}: out has {given['out'].size} elements, {least}")

    def _check_box(self, rows: Rows, shapes: set[tuple[int, ...]]) -> None:
        if len(shapes) > 1:
            raise ValueError(f"{self.label}: fields have the shapes {', '.join(map(str, sorted(shapes)))}")
        for shape in shapes:
            k, j, i = shape if len(shape) == 3 else (1, 1, shape[0])  # else a list
            if not self.listed and (rows.ends[0] > k or rows.ends[1] > j or rows.ends[2] > i):
                raise ValueError(f"{self.label}: fields have the shape {shape}, the box ends at {rows.ends}")


def _getter(names: list[str]) -> Any:
    """Return a function from a struct to its members of these names; None if there are none."""
    if len(names) == 1:
        return lambda s, name=names[0]: (getattr(s, name),)
    return attrgetter(*names) if names else None


@functools.cache
def _form(declared: RowPass, letters: Any, constants: Any, shape: str | Pattern, bounds: str) -> "Form":
    return Form(declared, dict(letters), dict(constants), shape, bounds)


TOGETHER: dict[str, list[RowPass]] = {}  # passes by the Warp module in which they are compiled


def _make_kernels_of_module(form: "Form", letters: Any, shape: str | Pattern, bounds: str) -> None:
    """Make the kernels that belong to a form's module before Warp loads it: for one more it would compile all of them again."""
    if not form.declared.module or form.pattern is not None:
        return
    for other in TOGETHER[form.declared.module]:
        if other.letters == form.declared.letters and other.words(dict(letters), other.constants, shape, bounds) == form.words:
            assert _form(other, letters, tuple(other.constants.items()), shape, bounds).kernel


class Form:
    """A pass whose types and constants are known.

    Attributes:
        words: what tells it from other forms.
        joins: whether it is compiled with other passes.
        name: of its kernel.
        fields: struct of its arguments.
        native: that struct in C.
        run: native function (layout, fields, slab, row, chunk of the first task, number of tasks).
    """

    def __init__(self, declared: RowPass, letters: dict[str, Any], constants: dict[str, int], shape: str | Pattern, bounds: str) -> None:
        self.declared, self.letters, self.bounds, d = declared, letters, bounds, declared
        self.pattern = pattern = shape if isinstance(shape, Pattern) else None
        self.joins = bool(d.module) and pattern is None  # the module of other passes
        shape = pattern.word if pattern else shape
        of = lambda kind: letters[kind] if isinstance(kind, str) else kind  # noqa: E731
        self.words = d.words(letters, constants, shape, bounds)
        weights = of(d.stencil[1]) if d.stencil and (shape == VARIABLE or (pattern and pattern.names)) else wp.float32
        parts = {"stencil": stencil_struct(of(d.stencil[0]), weights, pattern)} if d.stencil else {}
        parts |= {"bounds": BoundFields} if d.bounds else {}
        self.types = {name: of(kind) for name, kind in d.arrays.items()}
        members = {n: wp.array(dtype=t) for n, t in self.types.items()} | {n: of(t) for n, t in d.numbers.items()}
        self._numbers = struct.Struct("".join(PACKED[of(t)] for t in d.numbers.values()))
        self.fields = Fields = make_struct(f"{d.name.replace('.', '_')}_{'_'.join(self.words)}", parts | members)

        def run(L: RowLayout, given: Fields, slab_: int, row_: int, chunk_: int, count_: int): ...

        blank = Fields()
        self._struct, self.native, self._entry = type(blank), type(blank.__ctype__()), None
        self._size = ctypes.sizeof(self.native)
        area, _, last = d.name.rpartition(".")
        variant = ".".join(["warp_lcp", *([d.module] if self.joins else d.name.split(".")), "_".join(self.words)])
        run.__module__ = area if d.box else variant  # apart from other forms, which Warp would take for overloads
        self.name = d.name.replace(".", "_") if self.joins else last
        run.__qualname__ = f"{self.name}_rows"
        self.run = wp.func_native(self._source(letters, constants, ord(shape[0]), of))(run)

    def _source(self, letters: dict[str, Any], constants: dict[str, int], stencil: int, of: Any) -> str:
        """Return the body: a loop over pieces, in it pointers by name, the shared functions, the row function, the sums."""
        d, pattern = self.declared, self.pattern
        into = not {*d.ring}.isdisjoint(d.writes)
        levels = d.finer or bool(d.other)
        switches = {"RINGS": bool(d.ring), "INTO_RING": into, "LEVELS": levels, "BOX": bool(d.box)}
        switches |= {"BOUNDS": ord(self.bounds[0]), "STENCIL": stencil, "FOUND": len(d.found), "SUMS": len(d.sums)}
        macros = {n: v for n, v in constants.items() if hasattr(v, "__index__")}
        head = [f"typedef {C[t]} {n};" for n, t in letters.items()] + [f"typedef {C[of(d.compute)]} T;"] * ("T" not in letters)
        head += [f"constexpr int {n} = {int(v)};" for n, v in switches.items()] + [f"#define {n} {int(v)}" for n, v in macros.items()]
        head += [f"constexpr double {n} = {float(v)!r};" for n, v in constants.items() if n not in macros]
        at = {n: " + p + P.ring" if n in d.ring else " + p" for n in (*d.reads, *d.writes)} | dict.fromkeys(d.other, " + P.q")
        each = ["const Piece P = piece(k_i, j_i, c_, ring_); const int n = P.n; const long long p = P.p;"]
        each += [f"const long long yp = {'L.o2' if d.finer else 'P.yp'}, zp = {'L.o1' if d.finer else 'P.zp'};"]
        each += [f"const long long ym = {'-yp' if d.finer else 'P.ym'}, zm = {'-zp' if d.finer else 'P.zm'};"]
        each += ["const long long down = P.down, up = P.up;" if d.ring and not into else "const long long down = zm, up = zp;"]
        if levels:
            each += ["const bool pairs = L.fx > 1 || L.fx < -1; const int deep = L.fz == 1 || 2*P.k + 2 > L.n1 ? 1 : 2;"]
            each += ["const int wide = L.fy == 1 || 2*P.j + 2 > L.n2 ? 1 : 2;"]
        for n in (n for n in d.arrays if n not in d.box and not (d.found and n == "out")):
            pointer = f"given.{n}.data{at.get(n, '')}"
            pointer = f"given.{n}.data ? {pointer} : nullptr" if n in d.optional else pointer
            each += [f"{'const ' * (n in d.reads)}auto* {n} = {pointer};"]
        each += [f"const auto {n} = given.{n};" for n in d.numbers]
        if d.box:
            each += [f"double {n} = 0;" for n in d.found]
            each += [f"const long long s2 = given.{next(iter(d.box))}.shape[2], s1 = s2*given.{next(iter(d.box))}.shape[1];"]
            listed = [f"for (int m_ = P.first; m_ < P.first + n; ++m_) {{ const int at_ = {d.listed}[m_], k = at_ / (int)s1;"]
            listed += ["const int j = (at_ - k*(int)s1) / (int)s2, first = at_ % (int)s2, last = first + 1;"]
            each += listed if d.listed else ["const int k = P.k + k0, j = P.j + j0, first = P.first + i0, last = first + n;"]
            each += [f"auto* {n} = given.{n}.data ? given.{n}.data + k*s1 + j*s2 : nullptr;" for n in d.box]
        if d.stencil:
            fields, numbers = (pattern.names, pattern.numbers) if pattern else (("wx", "wy", "wz"), ("cx", "cy", "cz"))
            first = "P.q" if d.finer else "p"
            each += [f"const auto* {n} = given.stencil.{n}.data + {first};" for n in ("d", *fields, "known")]
            each += [f"const T {n} = (T)given.stencil.{n};" for n in ("unit", *numbers)]
            if pattern:
                at = f"const long long e = k + {first} - {'L.o0' if d.finer else 'L.base'}, a = yp, b = zp;"
                each += [
                    f"const auto place = [&](long long k) {{ {at}",
                    "return wp::vec3i((int)(e / b), (int)(e % b / a), (int)(e % a)); };",
                ]
                each += pattern.source()
        sums = [f"#define EACH_FOUND(DO) {' '.join(f'DO({s}, {name})' for s, name in enumerate(d.found))}", text(HEADERS / "sums.h")]
        sums += ["#undef EACH_FOUND"]
        common = [shared(h) for h, used in (("stencil.h", d.stencil), ("bounds.h", d.bounds)) if used]
        before = [shared("native.h"), '#line 1 "types"', *head, shared("piece.h"), shared("tasks.h"), '#line 1 "fields"', *each]
        body = ["{", text(d.header, d.declared), "}"] if d.box else [text(d.header, d.declared)]  # there names may be those of the pass
        closed = ["}"] * bool(d.listed)
        macros |= {"EACH_WEIGHT": 0} if pattern and d.stencil else {}
        tail = ['#line 1 "end"', "}}}", *(f"#undef {n}" for n in macros), ""]
        return "\n".join(["", *before, *common, *body, *closed, '#line 1 "sums"', *(sums if d.found else []), *tail])

    def fill(self, stencil: Any, bounds: Any, given: dict[str, Any]) -> bytes:
        """Return the struct of arguments as C has it: structs and arrays, which fill whole eight bytes, side by side, then numbers."""
        parts = [] if stencil is None else [stencil.struct.__ctype__()]
        if bounds is not None:
            lower, least, upper, most, code = bounds
            parts += [*packed((lower, upper, code)), SIDES.pack(least.value, most.value)]
        parts += packed([given[name] for name in self.types])
        values = [value_of(given[name]) for name in self.declared.numbers]
        try:
            parts.append(self._numbers.pack(*values))
        except struct.error as error:
            named = zip(self.declared.numbers, values, strict=True)
            raise TypeError(f"{self.declared.label}: {', '.join(f'{n} = {v!r}' for n, v in named)}: {error}") from None
        return b"".join(parts).ljust(self._size, b"\0")

    def struct_of(self, arguments: bytes, kept: Any) -> Any:
        """Return the struct of arguments for Warp; `kept` must live as long."""
        made = object.__new__(self._struct)
        made.__dict__.update(_kept=kept, _ctype=self.native.from_buffer_copy(arguments))
        return made

    @functools.cached_property
    def kernel(self) -> Any:
        """The kernel of the pass alone."""
        run, Fields, touch = self.run, self.fields, self.pattern.touch if self.pattern else None
        if touch is not None:

            def alone(L: RowLayout, F: Fields):
                i, j, c = wp.tid()
                if L.planes < 0:
                    touch(0)
                first = first_task(L)
                run(L, F, i + first[0], j + first[1], c + first[2], wp.max(L.end - L.begin, 1))
        else:

            def alone(L: RowLayout, F: Fields):
                i, j, c = wp.tid()
                first = first_task(L)
                run(L, F, i + first[0], j + first[1], c + first[2], wp.max(L.end - L.begin, 1))

        alone.__name__ = alone.__qualname__ = self.name
        if touch is not None:  # the caller's function may need what the project's flags leave out
            return wp.kernel(enable_backward=False, module=run.module.name)(alone)
        return forward_kernel(module=run.module.name)(alone)

    def entry(self, bound: "Bound") -> Entry:
        """Return the kernel as the team calls it."""
        if self._entry is None:
            self._entry = Entry(wp.launch(self.kernel, (1, 1, 1), [bound.layout, bound.fields], device="cpu", record_cmd=True))
        return self._entry


@wp.func_native("""
#ifdef __CUDA_ARCH__
return wp::vec3i(0, 0, 0);
#else
return wp::vec3i(L.begin / (L.rows*L.chunks), L.begin / L.chunks % L.rows, L.begin % L.chunks);
#endif
""")
def first_task(L: RowLayout) -> wp.vec3i:
    """Slab, row and chunk of a range's first task; 0 on CUDA, where a thread has one of its own."""


class Bound(NamedTuple):
    """A pass with its arguments.

    Attributes:
        form: the pass.
        rows: which it visits.
        arguments: struct of its arguments, as bytes.
        given: arrays and numbers by name.
        kept: what else has memory in it: the stencil, the operands of bounds.
    """

    form: Form
    rows: Rows
    arguments: bytes
    given: dict[str, Any]
    kept: Any

    @property
    def fields(self) -> Any:
        """The struct of arguments for Warp, which keeps their memory."""
        return self.form.struct_of(self.arguments, self)

    @property
    def layout(self) -> Any:
        """Where the rows are, for a pass that sums or one that does not."""
        return self.rows.summed if self.form.declared.found else self.rows.single

    def launch(self, launch: Launch | None = None) -> None:
        """Launch the pass, or record it."""
        if self.rows.device.is_cuda and (program := device_program(launch)) is not None:
            program.record_pass(self)
        elif self.rows.device.is_cuda or team() is None:
            (launch or wp.launch)(self.form.kernel, threads(self.layout), [self.layout, self.fields], device=self.rows.device)
        elif (made := self.operation()) is not None:
            perform(made, launch)

    def operation(self) -> Operation | None:
        """Return the pass for the team, cut into ranges of tasks; None where it has no task, or is not for the team."""
        recorded = self.rows.memory is not None and is_recording()
        if self.rows.device.is_cuda or team() is None or (0 in threads(self.layout) and not recorded):
            return None
        cost, sized = max(self.layout.grain * self.rows.weight, 1), self.rows.memory.sized if recorded else 0
        return ranges(self.stage(), cost, ordered=self.form.declared.ordered, sized=sized)

    def patches(self) -> list[Patch]:
        """Return what a recorded launch reads from memory: rows, numbers, and arrays that others replace."""
        d, native, patches = self.form.declared, self.form.native, []
        if self.rows.memory is not None:
            patches += self.rows.memory.patches(LAYOUT_BYTES + native.k0.offset if d.box else None)
        for name in self.form.types:
            if (slot := getattr(self.given[name], "slot", None)) is not None:
                patches.append((LAYOUT_BYTES + getattr(native, name).offset, slot.address, ARRAY_BYTES))
        for name, kind in d.numbers.items():
            if type(number := self.given[name]) is Scalar:
                kind = self.form.letters[kind] if isinstance(kind, str) else kind
                patches.append((LAYOUT_BYTES + getattr(native, name).offset, *number.address(kind)))
        return patches

    def stage(self, lag: int = 0, **members: int) -> Stage:
        """Return the pass for the team, as a stage of a wave whose layout has these members."""
        L = put(copy_of(self.layout), members) if members else self.layout
        patches = self.patches() if is_recording() else ()
        return Stage(
            self.form.entry(self),
            bytes(L.__ctype__()) + self.arguments,
            self,
            L.rows * L.chunks,
            threads(L)[0],
            lag,
            max(L.fz, 1),
            L.n1,
            patches,
        )


def slabs_of(planes: int, least: int, threads: int) -> tuple[int, int]:
    """Return into how many slabs planes are cut, and how many planes each has but the last: an even number, coarser planes stand for two.

    Args:
        planes: to cut, at least twice `least`.
        least: planes that a slab has at least.
        threads: that take them.
    """
    cuts = [(count, planes // count // 2 * 2) for count in range(2, min(planes // least, SLAB_PIECES * threads) + 1)]
    shares = [-(-count // threads) * each + planes - count * each for count, each in cuts]  # of the thread that has the last slab, and most
    return max(cut for cut, share in zip(cuts, shares, strict=True) if share <= 1.1 * min(shares))


class Wave:
    """Passes each of which follows some planes behind the one before: a CPU streams through memory once; on CUDA, launches.

    Args:
        name: of the kernel, as a pass has one.
        stages: at most four passes, each with how many planes it is behind the first.

    Raises:
        ValueError: there are too many, or the first is behind.
    """

    def __init__(self, name: str, *stages: tuple[RowPass, int]) -> None:
        if not 0 < len(stages) <= LARGEST or stages[0][1] or min(lag for _, lag in stages) < 0:
            raise ValueError(f"{name}: expected 1 to {LARGEST} passes, 0 and more planes behind the first")
        self.name, self.stages = name, stages

    def launch(self, *passes: Bound | None, launch: Any = launch_now) -> None:
        """Launch the passes, or record them; None leaves one out.

        Raises:
            TypeError: passes are others, or in another order, than declared.
            ValueError: threads share the rows of one out, as those of a flat field.
        """
        declared = tuple(stage for stage, _ in self.stages)
        given = [(b, lag) for b, (_, lag) in zip(passes, self.stages, strict=False) if b is not None]
        if len(passes) != len(declared) or any(b and b.form.declared is not stage for b, stage in zip(passes, declared, strict=True)):
            raise TypeError(f"{self.name}: takes {', '.join(stage.name for stage in declared)}, in this order")
        if not given:
            return
        if given[0][0].rows.device.is_cuda or max(b.layout.slab for b, _ in given) > 1:
            for bound, _ in given:
                bound.launch(launch)
            return
        if max([b.rows.single.chunks for b, _ in given]) > 1:
            raise ValueError(f"{self.name}: takes whole rows, not chunks of them")
        if team() is None:
            self._launch_planes(given, launch)
            return
        perform(self._operation(given), launch)

    def _launch_planes(self, given: list[tuple[Bound, int]], launch: Launch) -> None:
        """Launch the wave plane after plane, as `team.h` works through a slab."""
        for turn in range(max(b.layout.planes for b, _ in given) + max(lag for _, lag in given)):
            for bound, lag in given:
                L, i = bound.layout, turn - lag
                finer = max(L.fz, 1)  # planes that one of a coarser level stands for, whose turn comes with the last of them
                whole = finer == 1 or (i < L.n1 and ((i + 1) % finer == 0 or i == L.n1 - 1))
                if 0 <= (k := i // finer) < L.planes and whole:
                    there = put(copy_of(L), {"begin": k * L.rows, "end": (k + 1) * L.rows})
                    launch(bound.form.kernel, (1, 1, 1), [there, bound.fields], device=bound.rows.device)

    def _operation(self, given: list[tuple[Bound, int]]) -> Operation:
        """Return the wave for the team, cut into slabs of planes."""
        layouts = [b.layout for b, _ in given]
        planes, most = max(L.planes for L in layouts), max(lag for _, lag in given)
        least = 2 * (max(SLAB_PLANES, 2 * most + 5) // 2 + 1)  # so that the gaps lie apart, and three planes between those that are kept
        alone = get_threads() == 1 or any(L.turn or L.lift for L in layouts) or planes * max(L.rows * L.nx for L in layouts) < 2 * CELLS
        slabs, each = (1, planes) if alone or planes < 2 * least else slabs_of(planes, least, get_threads())
        members = {}
        if slabs > 1:
            apart = max([lag for b, lag in given if b.form.declared.ring], default=0) + 1
            members = {"cut": each, "slabs": slabs, "apart": apart}
        stages = [b.stage(lag, **(members if b.form.declared.ring else {})) for b, lag in given]
        return Operation(SLABS, stages, slabs, each, planes, most)
