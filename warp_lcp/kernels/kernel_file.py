"""Kernels of a header file: parser of their declarations.

The roles of a kernel's arguments stand above its row function; Python takes the kernels by name. A
declaration is a comment of a description and of lines with three blanks, a role and its arguments;
more blanks continue a line:

    // kernel cycle.sweep: a Jacobi sweep, y = x + omega (b - A x) / d, clipped to the bounds
    //   compute    S
    //   stencil    F, S
    //   reads      S x, b, lower?, upper?
    //   writes     S y
    //   numbers    S omega; bool from_zero, projected
    SIMD for (int k = 0; k < n; ++k) ...

Roles are the words of `StencilKernel`, except that `name?` marks an array that may be None. Fields
and numbers stand as in C: a type, then names. A type is Warp's (`float32`, `int8`, `vec3`), `int`
or `bool` of Python, a capital letter for the type of the arrays passed in, `T` for the type of
computations, or `vec3<T>`. `compute float32 | float64` leaves the choice to Python. `constants
AXIS, ROUNDED = 0`: Python computes the first, the second has a default value. `module multigrid`:
compiled in one Warp module with others that have the line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypedDict

import warp as wp

from warp_lcp.kernels.header_text import HeaderSection, sections
from warp_lcp.kernels.stencil_kernel import StencilKernel
from warp_lcp.kernels.types import DataType, FieldType

_INTEGERS = (wp.int8, wp.uint8, wp.int16, wp.uint16, wp.int32, wp.uint32, wp.int64, wp.uint64)
TYPES = {kind.__name__: kind for kind in (*_INTEGERS, wp.float32, wp.float64, int, bool)} | {
    "vec3": wp.vec3,
    "vec3d": wp.vec3d,
    "vec2i": wp.vec2i,
    "mat33": wp.mat33,
}
VECTORS: dict[FieldType, DataType] = {wp.float32: wp.vec3, wp.float64: wp.vec3d}
FIELDS = ("reads", "writes", "other", "by_row", "whole", "box", "numbers")
NAMES, FLAGS = ("ring", "sums", "largest"), ("bounds", "finer", "ordered", "by_cell")
ROLES = ("compute", "stencil", *FIELDS, *NAMES, *FLAGS, "listed", "constants", "module")
NONE: Mapping[str, float] = {}


class Roles(TypedDict):
    """Roles of a declaration, as arguments of `StencilKernel`."""

    stencil: tuple[FieldType, FieldType] | None
    reads: dict[str, FieldType]
    writes: dict[str, FieldType]
    other: dict[str, FieldType]
    by_row: dict[str, FieldType]
    whole: dict[str, FieldType]
    box: dict[str, FieldType]
    numbers: dict[str, FieldType]
    ring: tuple[str, ...]
    sums: tuple[str, ...]
    largest: tuple[str, ...]
    optional: tuple[str, ...]
    listed: str
    bounds: bool
    finer: bool
    ordered: bool
    by_cell: bool


class KernelFile:
    """Kernels that a header declares.

    Args:
        path: of the header.
        constants: a table of values by name, for constants that kernels in it declare; it may have
            more.

    Raises:
        ValueError: a declaration is wrong; names the file and the line.
    """

    def __init__(self, path: Path, constants: Mapping[str, float] = NONE) -> None:
        self.path, self._constants = path, dict(constants)
        self._kernels = {
            s.name: _Declaration(path, s) for s in sections(path).values() if s.kind == "kernel"
        }

    def __iter__(self) -> Iterator[str]:
        """Names of the kernels."""
        return iter(self._kernels)

    def __getitem__(self, name: str) -> StencilKernel:
        """Return a kernel that has no choices."""
        return self.kernel(name)

    def kernel(
        self,
        name: str,
        *,
        module: str = "",
        compute: FieldType | None = None,
        constants: Mapping[str, float] = NONE,
    ) -> StencilKernel:
        """Return a kernel, or a variant of it.

        Args:
            name: in the header.
            module: of the variant; it replaces the part before the last dot of the name.
            compute: type of computations, where the kernel leaves the choice.
            constants: those of the variant, beside those of the file.

        Raises:
            ValueError: there is no such kernel; a constant has no value, or no kernel declares it;
                the type is none of the kernel's.
        """
        if name not in self._kernels:
            raise ValueError(f"{self.path}: has no kernel {name}, but {', '.join(self._kernels)}")
        if unknown := sorted(
            constants.keys() - {n for d in self._kernels.values() for n in d.constants}
        ):
            raise ValueError(f"{self.path}: no kernel declares the constants {', '.join(unknown)}")
        return self._kernels[name].make(module, compute, self._constants | dict(constants))


class _Declaration:
    """Parsed declaration of a kernel, before types and constants are chosen."""

    def __init__(self, path: Path, section: HeaderSection) -> None:
        self.path, self.name, self.line, self.where = (
            path,
            section.name,
            section.line,
            f"{path}:{section.line}",
        )
        self.lines = _lines_of_roles(path, section)
        self._compute = [word.strip() for word in self._content("compute").split("|")]
        if not self._compute[0]:
            raise self._wrong("compute", "needs a type")
        self.constants = dict(self._constant(word) for word in self._words("constants"))
        for word in self._compute:  # a wrong role is reported for every choice of the type
            self._roles(self._type("compute", word))

    def make(
        self, module: str, compute: FieldType | None, constants: Mapping[str, float]
    ) -> StencilKernel:
        """Return the kernel of a module, a type of computations and constants."""
        choices = [self._type("compute", word) for word in self._compute]
        compute = choices[0] if compute is None and len(choices) == 1 else compute
        if compute not in choices:
            raise ValueError(
                f"{self.where}: {self.name}: compute is one of {', '.join(self._compute)}, not "
                f"{compute}"
            )
        if missing := [
            n for n, usual in self.constants.items() if usual is None and n not in constants
        ]:
            raise ValueError(
                f"{self.where}: {self.name}: Python gives no value for the constants "
                f"{', '.join(missing)}"
            )
        values = {
            name: value
            for name, usual in self.constants.items()
            if (value := constants.get(name, usual)) is not None
        }
        stem, _, last = self.name.rpartition(".")
        return StencilKernel(
            f"{module or stem}.{last}",
            self.path,
            compute,
            constants=values,
            declared=self.name,
            module=self._content("module"),
            **self._roles(compute),
        )

    def _roles(self, compute: FieldType | None) -> Roles:
        """Return the roles in the form of `StencilKernel`'s arguments."""
        optional: list[str] = []
        fields = {role: self._fields(role, compute, optional) for role in FIELDS}
        names = {role: tuple(self._words(role)) for role in NAMES}
        stencil = [self._type("stencil", word, compute) for word in self._words("stencil")]
        if stencil and len(stencil) != 2:
            raise self._wrong("stencil", "needs the types of the diagonal and of the weights")
        if (listed := self._content("listed")) and fields["whole"].get(listed) is not wp.int32:
            raise self._wrong("listed", f"names {listed}, which is no int32 array of `whole`")
        return Roles(
            stencil=(stencil[0], stencil[1]) if stencil else None,
            reads=fields["reads"],
            writes=fields["writes"],
            other=fields["other"],
            by_row=fields["by_row"],
            whole=fields["whole"],
            box=fields["box"],
            numbers=fields["numbers"],
            ring=names["ring"],
            sums=names["sums"],
            largest=names["largest"],
            optional=tuple(optional),
            listed=listed,
            bounds="bounds" in self.lines,
            finer="finer" in self.lines,
            ordered="ordered" in self.lines,
            by_cell="by_cell" in self.lines,
        )

    def _wrong(self, role: str, why: str) -> ValueError:
        return ValueError(
            f"{self.path}:{self.lines.get(role, (self.line, ''))[0]}: {self.name}: {role} {why}"
        )

    def _content(self, role: str) -> str:
        return self.lines.get(role, (0, ""))[1]

    def _words(self, role: str) -> list[str]:
        content = self._content(role)
        words = [word.strip() for word in content.split(",")] if content else []
        if role in NAMES and (wrong := [word for word in words if not word.isidentifier()]):
            raise self._wrong(role, f"has {wrong[0]!r}, which is not a name")
        return words

    def _constant(self, word: str) -> tuple[str, float | None]:
        found = re.fullmatch(r"([A-Za-z]\w*)(?: = (-?\d+)(\.\d+)?)?", word)
        if not found:
            raise self._wrong("constants", f"has {word!r}: expected `NAME` or `NAME = number`")
        if not found[2]:
            return found[1], None
        return found[1], float(found[2] + found[3]) if found[3] else int(found[2])

    def _fields(
        self, role: str, compute: FieldType | None, optional: list[str]
    ) -> dict[str, FieldType]:
        fields: dict[str, FieldType] = {}
        content = self._content(role)
        for group in content.split(";") if content else []:
            kind, _, names = group.strip().partition(" ")
            of_group = self._type(role, kind, compute)
            for word in names.split(","):
                name = word.strip().removesuffix("?")
                if (
                    not name.isidentifier()
                    or name in fields
                    or (role == "numbers" and word.endswith("?"))
                ):
                    raise self._wrong(
                        role,
                        f"has {word.strip()!r} in `{group.strip()}`: expected `type name, name?; "
                        "type name`",
                    )
                fields[name] = of_group
                optional += [name] * word.endswith("?")
        return fields

    def _type(self, role: str, word: str, compute: FieldType | None = None) -> FieldType:
        if word in TYPES:
            return TYPES[word]
        if word == "T" and compute is not None:
            return compute
        if word == "vec3<T>" and compute in VECTORS:
            return VECTORS[compute]
        if re.fullmatch("[A-Z]", word) and word != "T":
            return word
        raise self._wrong(
            role,
            f"has the type {word!r}: expected {', '.join(TYPES)}, T, vec3<T> or a capital letter",
        )


def _lines_of_roles(path: Path, section: HeaderSection) -> dict[str, tuple[int, str]]:
    """Return the line and the content of each role.

    Raises:
        ValueError: a role is unknown or repeated, lacks its content, or must not have one.
    """
    roles: dict[str, tuple[int, str]] = {}
    role = ""
    for number, line in enumerate(section.declaration, section.line):
        where = f"{path}:{number}: {section.name}"
        if not line.startswith("//   "):
            continue
        if role and line.startswith("//     "):
            roles[role] = (roles[role][0], f"{roles[role][1]} {line[2:].strip()}")
            continue
        role, _, content = line[5:].partition(" ")
        if role not in ROLES:
            raise ValueError(f"{where}: {role!r} is not a role: expected {', '.join(ROLES)}")
        if role in roles:
            raise ValueError(f"{where}: {role} stands twice")
        roles[role] = (number, content.strip())
    for role, (number, content) in roles.items():
        if bool(content) == (role in FLAGS):
            raise ValueError(
                f"{path}:{number}: {section.name}: {role} takes "
                f"{'nothing' if role in FLAGS else 'names'}"
            )
    return roles
