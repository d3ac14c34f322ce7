# mypy: ignore-errors
"""Stencil kernels: fields with roles and a C++ row function, launched by name.

They can be composed to fused kernels. A row function sees a piece: pointers to its first cell, the
number n of its cells, the offsets ym, yp, zm, zp of the rows beside it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from operator import attrgetter, index
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import warp as wp

from warp_lcp.kernels.header_text import sections
from warp_lcp.kernels.kernel_variant import (
    KNOWN,
    NUMBERS,
    PACKED,
    PLACE,
    QUADS,
    TOGETHER,
    UNIFORM,
    VARIABLE,
    C,
    KernelVariant,
    form_of,
    make_kernels_of_module,
)
from warp_lcp.kernels.launch_graph import Launch, device_program, is_recording, perform
from warp_lcp.kernels.layout import (
    BoundOperands,
    KernelStencil,
    PrecomputedProduct,
    RowLayout,
    copy_of,
    native_of,
    offset_of,
    put,
    threads,
)
from warp_lcp.kernels.recorded_arguments import (
    ARRAY_BYTES,
    LAYOUT_BYTES,
    KernelArgument,
    Scalar,
    slot_of,
)
from warp_lcp.kernels.rows import Rows
from warp_lcp.kernels.thread_pool import Operation, OperationKind, Patch, ranges, team
from warp_lcp.kernels.types import DataType, DeviceArray, FieldType, StructInstance

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Getter: TypeAlias = "Callable[[DataclassInstance], Sequence[KernelArgument]]"
Plan: TypeAlias = "tuple[tuple[str, ...], tuple[Getter | None, ...]]"

ARRAYS = (wp.array, wp.indexedarray)
BLOCK_BYTES = 16  # bytes that a thread loads at a time
# Fields of one element a row that row functions only set, or find set: several threads may do so.
FLAGGED = ("changed", "away")
# Names that this package uses itself.
OWN = frozenset(
    (
        "self",
        "rows",
        "stencil",
        "bounds",
        "given",
        "P",
        "n",
        "p",
        "ym",
        "yp",
        "zm",
        "zp",
        "down",
        "up",
        "c_",
        "_ctype",
    )
)


@dataclass(frozen=True, eq=False)
class StencilKernel:
    """Declaration of a kernel over the cells of rows.

    Types of fields are Warp's, or letters: a letter stands for one type, that of the arrays passed
    in, and is its name in the row function. `T` there is the type of computations.

    Args:
        name: of the kernel, with the area before it: `projected_multigrid.assess`.
        header: C++ row function, or the header of an area in which it is `declared`.
        compute: type that T stands for.
        stencil: types of the diagonal and the weights of `row_functions.h`, if it has one. `affine`
            is A x + b: of the stencil, or precomputed.
        bounds: whether it has those of `row_functions.h`.
        reads: fields, pointers to the piece's first cell.
        writes: likewise, written.
        ring: those of the fields that keep three planes only; the pointer is to its plane there,
            `down` and `up` are the offsets to the planes around it.
        other: fields of the other level of a transfer, pointers to the element that belongs to the
            first cell. Cells belong together in `pairs` along x or not; `deep` planes and `wide`
            rows of a finer level belong to one of ours.
        finer: whether the stencil and the offsets are those of the other level, which is finer.
        by_row: one element a row of the grid: pointers to the first row's; `P.row` counts.
        whole: small arrays: pointers to the first element.
        box: fields of all cells of a grid, of `Rows.box`: pointers to the first stored cell of row
            j of plane k, null where there is none; of one that has layers, in its first. The piece
            is first <= i < last; the planes of the first field are s1 elements apart, its rows s2.
            Such a kernel has no letters and one variant, in the Warp module that its name begins
            with. Lists count as fields, too.
        listed: int32 array of `whole` with the flat indices of the cells that are visited; the box
            is then that of the list's entries.
        optional: arrays that may be None, or empty: their pointers are null then.
        numbers: passed by the host.
        sums: variables of the row function that are summed over the cells. Those of a kernel over a
            box are doubles, and 0 before a piece.
        largest: likewise, reduced by the maximum; after the sums.
        ordered: whether tasks write what others read or write: on the CPU one thread takes them, in
            order.
        by_cell: whether a thread takes one cell on CUDA, not four of a row: its work on one is
            long, or reaches what others write.
        constants: numbers that are known when the kernel is made, with their default values; those
            that are passed in are integers, and macros.
        declared: the kernel's name in the header, see `kernel_file.py`; empty: the header is the
            row function alone.
        module: Warp module of kernels that are used together. They are compiled at once for each
            set of types: a module of its own costs 0.04 s before its first kernel. Not for a kernel
            over a box, whose module its name begins with.

    Raises:
        ValueError: a name cannot be one in C++, is used by this package, or stands for two things;
            a role or a letter is of no array.
        TypeError: a number is of a type that cannot be passed.
    """

    name: str
    header: Path
    compute: FieldType
    stencil: tuple[FieldType, FieldType] | None = None
    bounds: bool = False
    reads: Mapping[str, FieldType] = field(default_factory=dict)
    writes: Mapping[str, FieldType] = field(default_factory=dict)
    ring: tuple[str, ...] = ()
    other: Mapping[str, FieldType] = field(default_factory=dict)
    finer: bool = False
    by_row: Mapping[str, FieldType] = field(default_factory=dict)
    whole: Mapping[str, FieldType] = field(default_factory=dict)
    optional: tuple[str, ...] = ()
    numbers: Mapping[str, FieldType] = field(default_factory=dict)
    sums: tuple[str, ...] = ()
    largest: tuple[str, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict)
    box: Mapping[str, FieldType] = field(default_factory=dict)
    listed: str = ""
    ordered: bool = False
    by_cell: bool = False
    declared: str = ""
    module: str = ""

    def __post_init__(self) -> None:
        """Check names, and create the variant of a box at once.

        Otherwise a Warp module that is loaded already would be compiled again with it.
        """
        self._check_names()
        if self.module:
            TOGETHER.setdefault(self.module, []).append(self)
        if self.box:
            object.__setattr__(self, "numbers", {**self.numbers, **dict.fromkeys(PLACE, int)})
            assert form_of(self, (), tuple(self.constants.items()), UNIFORM, NUMBERS).kernel

    def _check_names(self) -> None:
        """Check the declaration.

        A compiler would report some errors later, others not at all.
        """
        numbers = {n: kind for n, kind in self.numbers.items() if not (self.box and n in PLACE)}
        fields = (self.reads, self.writes, self.other, self.by_row, {**self.whole, **self.box})
        groups = (
            *fields,
            numbers,
            self.constants,
            self.reductions and ("out", *(self.reductions if self.box else ())),
        )
        names = [name for group in groups for name in group]
        wrong = {
            name
            for name in names
            if names.count(name) > 1 or not name.isidentifier() or name in OWN
        }
        wrong |= {*self.ring} - {*self.reads, *self.writes} | {*self.optional} & {*[*self.box][:1]}
        wrong |= {part for part in self.name.split(".") if not part.isidentifier()}
        known = {*self.arrays.values(), *(self.stencil or ())}
        wrong |= {
            kind
            for kind in (self.compute, *numbers.values())
            if isinstance(kind, str) and kind not in known
        }
        if wrong:
            expected = (
                "names that are free, rings of fields, letters of arrays, a first field of "
                "a box that is not optional"
            )
            raise ValueError(f"{self.label}: {sorted(wrong)}: expected {expected}")
        if wrong_types := {
            name
            for name, kind in numbers.items()
            if not isinstance(kind, str) and kind not in PACKED
        }:
            raise TypeError(
                f"{self.label}: {sorted(wrong_types)}: expected numbers of the types "
                f"{', '.join(t.__name__ for t in PACKED)}"
            )

    @functools.cached_property
    def source(self) -> str:
        """File and line of the declaration."""
        return f"{self.header}:{sections(self.header)[self.declared].line if self.declared else 1}"

    @functools.cached_property
    def label(self) -> str:
        """Name and place of the declaration, for messages."""
        return f"{self.name} ({self.source})" if self.declared else self.name

    @functools.cached_property
    def letters(self) -> frozenset[str]:
        """Letters that stand for types."""
        return frozenset(
            kind for kind in (*self.arrays.values(), *(self.stencil or ())) if isinstance(kind, str)
        )

    @functools.cached_property
    def reductions(self) -> tuple[str, ...]:
        """Names of the sums, then of the maxima."""
        return (*self.sums, *self.largest)

    @functools.cached_property
    def quads(self) -> bool:
        """Whether a thread can take four cells of a row at a time on CUDA.

        Only kernels over the rows of grids can.
        """
        elsewhere = self.box or self.ring or {*self.by_row} - {*FLAGGED}
        return not (elsewhere or self.ordered or self.by_cell)

    @functools.cached_property
    def arrays(self) -> dict[str, FieldType]:
        """Types of all arrays by name.

        `out` receives the sums and maxima, a column each.
        """
        out = {"out": wp.float64} if self.reductions else {}
        return {
            **self.reads,
            **self.writes,
            **self.other,
            **self.by_row,
            **self.whole,
            **self.box,
            **out,
        }

    def bind(
        self,
        rows: Rows,
        *structs: DataclassInstance,
        stencil: KernelStencil | None = None,
        bounds: BoundOperands | None = None,
        **kernel_args: KernelArgument,
    ) -> BoundKernel:
        """Check the arguments of a launch and bind them.

        Args:
            rows: the rows to visit.
            structs: dataclasses whose members have the names of arguments; the kernel takes those
                that it declares.
            stencil: a `warp_lcp.operators.padded_stencil.PaddedStencil`, or a `PrecomputedProduct`
                in place of one.
            bounds: operands of a `warp_lcp.problem.bounds.Bounds`.
            kernel_args: arrays, numbers, and constants other than their defaults, by name; they
                override members of structs.

        Raises:
            TypeError: an argument is missing, unknown, or of the wrong type; two structs have it; a
                struct is no dataclass.
            ValueError: an array has the wrong length, lies on another device, or its elements do
                not lie side by side.
        """
        return self.bind_arguments(rows, structs, kernel_args, stencil, bounds)

    def bind_arguments(
        self,
        rows: Rows,
        structs: tuple[DataclassInstance, ...],
        kernel_args: dict[str, KernelArgument],
        stencil: KernelStencil | None = None,
        bounds: BoundOperands | None = None,
    ) -> BoundKernel:
        """Bind as `bind` does, with structs and keywords as containers.

        It serves functions that pass on the arguments of their callers. `kernel_args` is modified.
        """
        if (self.stencil is None) != (stencil is None) or self.bounds == (bounds is None):
            verb = {True: "needs", False: "takes no"}
            raise TypeError(
                f"{self.label}: {verb[self.stencil is not None]} stencil, {verb[self.bounds]} "
                "bounds"
            )
        if structs:
            kernel_args = self.with_members(structs, kernel_args)
        if self.box:
            kernel_args |= rows.place
            constants = tuple(self.constants.values())
        else:
            try:
                constants = (
                    tuple(
                        [
                            index(kernel_args.pop(n)) if n in kernel_args else v
                            for n, v in self.constants.items()
                        ]
                    )
                    if self.constants
                    else ()
                )
            except TypeError as error:
                raise TypeError(
                    f"{self.label}: {', '.join(self.constants)} are integers where given: {error}"
                ) from None
        if kernel_args.keys() != self._expected_names:
            missing, unknown = (
                sorted(self._expected_names - kernel_args.keys()),
                sorted(kernel_args.keys() - self._expected_names),
            )
            searched = (
                f" in {', '.join(type(s).__name__ for s in structs)}" if structs and missing else ""
            )
            raise TypeError(f"{self.label}: missing {missing}{searched}, unknown {unknown}")
        types = [
            value.dtype if isinstance(value := kernel_args[n], ARRAYS) else type(value)
            for n in self.arrays
        ]
        kind, weights, stored = NUMBERS, None, ()
        if bounds:
            lower, _, upper, _, code = bounds
            if length := code.size or lower.size or upper.size:
                kind = "coded" if code.size else "fields"
                if length != rows.size:
                    raise ValueError(
                        f"{self.label}: bounds have {length} elements, not {rows.size}"
                    )
        if stencil is not None:
            d, weights, pattern = stencil.d, stencil.weights, stencil.pattern
            stored = (type(stencil), pattern, d.dtype, weights[0].dtype if weights else None)
            if d.size != (rows.other_size if self.finer else rows.size):
                raise ValueError(
                    f"{self.label}: the stencil has {d.size} elements, not "
                    f"{rows.other_size if self.finer else rows.size}"
                )
        quads = None
        if (
            rows.quads is not None
            and self.quads
            and rows.memory is None
            and not (stored and stored[1])
        ):
            fields = rows.alignments != QUADS and self._fields_of_rows(kernel_args, stencil, bounds)
            quads = rows.alignments if fields and in_blocks(fields) else QUADS
        key = (constants, kind, quads, *stored, *types)
        variant = self._forms.get(key)
        if variant is None:
            letters = tuple(sorted(self._letters(stencil, kernel_args).items()))
            numbers = tuple(zip(self.constants, constants, strict=True))
            shape = (
                KNOWN
                if isinstance(stencil, PrecomputedProduct)
                else stored[1]
                if stencil and stored[1]
                else VARIABLE
                if weights
                else UNIFORM
            )
            variant = self._forms[key] = form_of(self, letters, numbers, shape, kind, quads=quads)
            make_kernels_of_module(variant, letters, shape, kind)
        self._check_memory(rows, kernel_args)
        return BoundKernel(
            variant,
            rows,
            variant.fill(stencil, bounds, kernel_args),
            kernel_args,
            (stencil, bounds),
        )

    def with_members(
        self, structs: tuple[DataclassInstance, ...], kernel_args: dict[str, KernelArgument]
    ) -> dict[str, KernelArgument]:
        """Return the arguments among the structs' members, and those of `kernel_args`.

        Of a name in both, the value in `kernel_args` counts.
        """
        kinds = tuple([type(s) for s in structs])
        plan = self._members.get(kinds)
        if plan is None:
            plan = self._members[kinds] = self._plan(kinds)
        names, getters = plan
        values = [
            value
            for s, get in zip(structs, getters, strict=True)
            if get is not None
            for value in get(s)
        ]
        return {**dict(zip(names, values, strict=True)), **kernel_args}

    def _plan(self, kinds: tuple[type, ...]) -> Plan:
        """Return the arguments that structs of these classes have.

        For each class: a function that gets them, or None.
        """
        if others := [kind.__name__ for kind in kinds if not is_dataclass(kind)]:
            raise TypeError(f"{self.label}: {others[0]} is not a dataclass")
        shares = [
            [f.name for f in fields(kind) if f.name in self._expected_names] for kind in kinds
        ]
        names = tuple(name for share in shares for name in share)
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise TypeError(
                f"{self.label}: {', '.join(kind.__name__ for kind in kinds)}: two of them have "
                f"{twice}"
            )
        return names, tuple(_getter(share) for share in shares)

    def words(
        self, letters: dict[str, DataType], constants: Mapping[str, float], shape: str, bounds: str
    ) -> list[str]:
        """Return the key of a kernel variant.

        It holds the kinds of stencil and bounds, the types, and the constants that differ from
        their defaults.
        """
        differing = [
            f"{name.lower()}{value}"
            for name, value in constants.items()
            if value != self.constants[name]
        ]
        kinds = [shape] * bool(self.stencil) + [bounds] * (self.bounds and bounds != NUMBERS)
        return [*kinds, *(t.__name__ for _, t in sorted(letters.items())), *differing]

    def _fields_of_rows(
        self,
        given: dict[str, KernelArgument],
        stencil: KernelStencil | None,
        bounds: BoundOperands | None,
    ) -> list[DeviceArray | None]:
        """Return the fields that quads may read in blocks."""
        fields = [given[name] for name in (*self.reads, *self.writes, *self.other)]
        if stencil is not None:
            product = [stencil.y] if isinstance(stencil, PrecomputedProduct) else []
            fields += [stencil.d, *(stencil.weights or ()), *product]
        return [*fields, *(bounds or ())[::2]]

    @functools.cached_property
    def _members(self) -> dict[tuple[type, ...], Plan]:
        """Cached results of `with_members`, by the classes of structs."""
        return {}

    @functools.cached_property
    def _expected_names(self) -> frozenset[str]:
        return frozenset({*self.arrays, *self.numbers})

    @functools.cached_property
    def _forms(self) -> dict[tuple[Hashable, ...], KernelVariant]:
        """Cached variants by types and constants, so that types are checked once."""
        return {}

    def _letters(
        self, stencil: KernelStencil | None, kernel_args: dict[str, KernelArgument]
    ) -> dict[str, DataType]:
        """Resolve the letters, and check the types of all arrays."""
        letters: dict[str, DataType] = {}
        seen: dict[str, str] = {}
        pairs = [(name, kind, kernel_args[name]) for name, kind in self.arrays.items()]
        if self.stencil is not None:
            pairs += [("the stencil's d", self.stencil[0], stencil.d)]
            pairs += (
                [("the stencil's weights", self.stencil[1], stencil.weights[0])]
                if stencil.weights
                else []
            )
        for name, kind, value in pairs:
            if value is None and name in self.optional:
                continue
            dtype = value.dtype if isinstance(value, wp.array) else type(value)
            expected = letters.setdefault(kind, dtype) if isinstance(kind, str) else kind
            if not isinstance(value, wp.array) or dtype is not expected:
                why = f", as {seen[kind]}" if isinstance(kind, str) and kind in seen else ""
                raise TypeError(
                    f"{self.label}: {name} is {dtype.__name__}, not an array of "
                    f"{expected.__name__}{why}"
                )
            seen.setdefault(kind, name)
        if unsupported := [
            f"{seen[kind]} is {dtype.__name__}" for kind, dtype in letters.items() if dtype not in C
        ]:
            raise TypeError(
                f"{self.label}: {unsupported[0]}: a letter stands for "
                f"{', '.join(t.__name__ for t in C)}"
            )
        # Letters of absent arrays.
        return letters | dict.fromkeys(self.letters - letters.keys(), wp.float32)

    @functools.cached_property
    def _lengths(self) -> list[tuple[Callable[[Rows], int] | None, tuple[str, ...]]]:
        """Names of the arrays of each length.

        A function returns that length of rows; None: any length.
        """
        sized = (
            (attrgetter("size"), {**self.reads, **self.writes}),
            (attrgetter("other_size"), self.other),
            (attrgetter("count"), self.by_row),
        )
        groups = (
            *sized,
            (None, {**self.whole, **self.box, **dict.fromkeys(("out",) * bool(self.reductions))}),
        )
        return [(length, tuple(names)) for length, names in groups if names]

    def _check_memory(self, rows: Rows, kernel_args: dict[str, KernelArgument]) -> None:
        device = rows.device
        for length, names in self._lengths:
            expected = None if length is None else length(rows)
            for name in names:
                value = kernel_args[name]
                size = 0 if value is None else value.size
                if not size and name in self.optional and slot_of(value) is None:
                    # An empty slice has an address. A list that grows is read when the launch runs.
                    kernel_args[name] = None
                if size != expected is not None and (size or name not in self.optional):
                    raise ValueError(f"{self.label}: {name} has {size} elements, not {expected}")
                if size and not (value.is_contiguous and value.device is device):
                    why = f"on {value.device}, not {device}" if value.is_contiguous else "strided"
                    raise ValueError(f"{self.label}: {name} is {why}")
        if self.box:
            self._check_box(
                rows,
                {tuple(kernel_args[n].shape[-3:]) for n in self.box if kernel_args[n] is not None},
            )
        if self.reductions and kernel_args["out"].size < len(self.reductions) * rows.places:
            least = (
                f"fewer than {len(self.reductions) * rows.places}: {rows.places} threads for each "
                "sum"
            )
            raise ValueError(f"{self.label}: out has {kernel_args['out'].size} elements, {least}")

    def _check_box(self, rows: Rows, shapes: set[tuple[int, ...]]) -> None:
        if len(shapes) > 1:
            raise ValueError(
                f"{self.label}: fields have the shapes {', '.join(map(str, sorted(shapes)))}"
            )
        for shape in shapes:
            k, j, i = shape if len(shape) == 3 else (1, 1, shape[0])  # a list has one dimension
            if not self.listed and (rows.ends[0] > k or rows.ends[1] > j or rows.ends[2] > i):
                raise ValueError(
                    f"{self.label}: fields have the shape {shape}, the box ends at {rows.ends}"
                )


def _getter(names: list[str]) -> Getter | None:
    """Return a function from a struct to its members of these names.

    Returns None if there are no names.
    """
    if len(names) == 1:
        get = attrgetter(names[0])
        return lambda struct: (get(struct),)
    return attrgetter(*names) if names else None


def in_blocks(fields: list[DeviceArray | None]) -> bool:
    """Return whether all fields begin with an aligned block of 16 bytes.

    Their memory must not be replaced later.
    """
    arrays = [value for value in fields if isinstance(value, wp.array) and value.size]
    return all(value.ptr % BLOCK_BYTES == 0 and slot_of(value) is None for value in arrays)


class BoundKernel(NamedTuple):
    """A stencil kernel with its arguments.

    Attributes:
        form: the variant.
        rows: that it visits.
        arguments: struct of its arguments, as bytes.
        given: arrays and numbers by name.
        kept: other owners of memory in it: the stencil, the operands of bounds.
    """

    form: KernelVariant
    rows: Rows
    arguments: bytes
    kernel_args: dict[str, KernelArgument]
    keep_alive: tuple[KernelStencil | None, BoundOperands | None]

    @property
    def fields(self) -> StructInstance:
        """The struct of arguments for Warp, which holds references to their memory."""
        return self.form.struct_of(self)

    @property
    def layout(self) -> RowLayout:
        """Layout of the rows, for a kernel that sums or one that does not."""
        return (
            self.rows.summed
            if self.form.declared.reductions
            else self.rows.quads
            if self.form.quads
            else self.rows.single
        )

    def launch(self, launch: Launch | None = None) -> None:
        """Launch the kernel, or record it."""
        if self.rows.device.is_cuda and (program := device_program(launch)) is not None:
            program.record_pass(self)
        elif self.rows.device.is_cuda or team() is None:
            (launch or wp.launch)(
                self.form.kernel,
                self.form.dim(self.layout),
                [self.layout, self.fields],
                device=self.rows.device,
            )
        elif (made := self.operation()) is not None:
            perform(made, launch)

    def operation(self) -> Operation | None:
        """Return the kernel for the thread pool, cut into ranges of tasks.

        Returns None where it has no task, or does not suit the pool.
        """
        recorded = self.rows.memory is not None and is_recording()
        if (
            self.rows.device.is_cuda
            or team() is None
            or (0 in threads(self.layout) and not recorded)
        ):
            return None
        cost, sized = (
            max(self.layout.grain * self.rows.weight, 1),
            self.rows.memory.sized if recorded else 0,
        )
        return ranges(self.stage(), cost, ordered=self.form.declared.ordered, sized=sized)

    def patches(self) -> list[Patch]:
        """Return the patches of a recorded launch, which it reads from memory.

        They are rows, numbers, and replaceable arrays.
        """
        d, native, patches = self.form.declared, self.form.native, []
        if self.rows.memory is not None:
            patches += self.rows.memory.patches(
                LAYOUT_BYTES + offset_of(native, "k0") if d.box else None
            )
        for name in self.form.types:
            if (slot := slot_of(self.kernel_args[name])) is not None:
                patches.append((LAYOUT_BYTES + offset_of(native, name), slot.address, ARRAY_BYTES))
        for name, kind in d.numbers.items():
            if type(number := self.kernel_args[name]) is Scalar:
                kind = self.form.letters[kind] if isinstance(kind, str) else kind
                patches.append((LAYOUT_BYTES + offset_of(native, name), *number.address(kind)))
        return patches

    def stage(self, lag: int = 0, **members: int) -> OperationKind:
        """Return the kernel as a stage of a fused kernel, for the thread pool.

        Its layout has these members.
        """
        L = put(copy_of(self.layout), members) if members else self.layout
        patches = self.patches() if is_recording() else ()
        return OperationKind(
            self.form.entry(self),
            bytes(native_of(L)) + self.arguments,
            self,
            L.rows * L.chunks,
            threads(L)[0],
            lag,
            max(L.fz, 1),
            L.n1,
            patches,
        )
