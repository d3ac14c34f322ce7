"""Interface of operators: members of each, and optional capabilities.

Some methods need capabilities, others use them if present. An operator has a capability if it has
the members; `has` decides that, and is the only function that looks for them by name. A method
lists in `supports` the capabilities of which it needs one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import (
    TYPE_CHECKING,
    Generic,
    Protocol,
    TypeAlias,
    TypeGuard,
    TypeVar,
    runtime_checkable,
)

import numpy as np
import warp as wp

from warp_lcp.kernels.fields import Layout
from warp_lcp.kernels.types import DataType, DeviceArray, Values
from warp_lcp.problem.residual_scaling import NoTranspose, estimated_scale
from warp_lcp.settings import renamed_names

if TYPE_CHECKING:
    from warp_lcp.kernels.fields import PaddedLayout
    from warp_lcp.operators.components import FloatingComponents
    from warp_lcp.operators.compressed_rows import CompressedRows
    from warp_lcp.operators.low_rank import LowRankOperator
    from warp_lcp.operators.padded_stencil import PaddedStencil
    from warp_lcp.problem.method_protocol import Solver

AIR, FLUID, SOLID = 0, 1, 2  # types of a grid's cells
FLOAT32_ROUNDING = 2.0**-24  # largest relative rounding of a number in float32
Capability = TypeVar("Capability", bound="Operator")
Declaration = TypeVar("Declaration")
Scratch: TypeAlias = tuple[DeviceArray, DeviceArray]  # stored fields that may be overwritten
Derivatives: TypeAlias = dict[str, "Derivative"]  # by the names of a constructor's arguments
Derivative: TypeAlias = DeviceArray | float | Mapping[tuple[int, ...], DeviceArray | float] | None


@runtime_checkable
class Operator(Protocol):
    """Protocol of square linear operators A on fields of shape `shape`.

    Define your own by inheriting from this protocol (write `shape`, `device` and `apply`), or by
    defining all its members; a product of NumPy arrays makes one by `wl.LinearOperator`. Docs
    "Operators of your own" shows both. Fields are plain contiguous arrays of that shape. Optional
    features are capabilities (`warp_lcp.problem.operator_protocol`): an operator has one if it has
    its members.

    Attributes:
        shape: shape of the fields that A maps to each other.
        dtype: type in which A's entries are stored, wp.float32 or wp.float64, which is the default.
        device: the device of A's arrays.
        symmetric: whether A equals its transpose; by default it is not taken to.
    """

    shape: tuple[int, ...]
    dtype: DataType = wp.float64
    device: wp.Device
    symmetric: bool = False

    @abstractmethod
    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x, in `out` if given."""

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A' x, in `out` if given; by default A x of a symmetric A.

        Raises:
            NoTranspose: A is not symmetric, and has no transpose of its own. It is a ValueError.
        """
        if not self.symmetric:
            raise NoTranspose(
                f"{type(self).__name__} has no apply_transpose and is not symmetric: define it, or "
                "use MinimumMapNewton"
            )
        return self.apply(x, out)

    def diagonal(self) -> DeviceArray:
        """Return the diagonal of A as a field of type `dtype`.

        By default row and column norms, estimated from 16 products at each call, are used instead:
        positive, and for a dominant diagonal of about the same size. Preconditioners and step
        lengths are then nearly as good as with the diagonal.
        """
        layout = layout_of(self)
        unknown = (
            self.cells.numpy().ravel() == 1
            if has(self, HasCells)
            else np.ones(layout.size, dtype=bool)
        )
        sizes = estimated_scale(self, layout, unknown) * unknown
        return wp.array(sizes.reshape(layout.stored_shape), dtype=self.dtype, device=self.device)


class HasRows(Operator, Protocol):
    """Access to the entries of A by rows.

    For sweeps in any order, blocks, and proofs that there is no solution.

    Attributes:
        row_sizes: the largest magnitude of each row, shape (n,), wp.float64; None where no row is
            empty. The unknown of an empty row goes to the bound that b's sign selects.
    """

    row_sizes: DeviceArray | None

    def rows(self) -> CompressedRows:
        """Return the rows of A for flat stored fields, in the operator's own memory."""


class HasSweep(Operator, Protocol):
    """Sweep in the operator's own order."""

    def relax(
        self,
        x: DeviceArray,
        b: DeviceArray,
        lower: DeviceArray,
        upper: DeviceArray,
        omega: float,
        *,
        forward: bool = True,
    ) -> None:
        """Sweep once: x_i = clip(x_i - omega (A x + b)_i / A_ii, l_i, u_i) in turn.

        In the reverse order if not `forward`.

        All are flat stored fields of one type; x is moved in place. Rows with a zero diagonal are
        passed over.
        """


class HasLayout(Operator, Protocol):
    """Storage layout of fields that are not plain arrays.

    Attributes:
        layout: loads and unloads them. `apply` and `apply_transpose` take stored fields too, flat
            or of `layout.stored_shape`.
    """

    layout: Layout


class HasVersion(Operator, Protocol):
    """Counter of in-place changes of the entries.

    Attributes:
        version: another number after each change; methods update data derived from A when the next
            solve starts.
    """

    version: int


class HasCells(Operator, Protocol):
    """Mask of the elements of a field that are unknowns.

    Attributes:
        cells: wp.int8, one for each element of a stored field, 1 (FLUID) where it is an unknown;
            others stay 0.
    """

    cells: DeviceArray


class HasStencil(HasCells, HasLayout, HasVersion, Protocol):
    """Compact stencil of a grid operator, of 5, 7 or more points.

    For multigrid and for kernels that compute A x on the way.

    Attributes:
        stencil: the diagonal and the weights of neighbors; of 5 and 7 points A is symmetric with
            weights >= 0 and weakly dominant rows.
        periodic: whether x, y, z wrap around.
        layout: with a ghost cell on each side.
    """

    stencil: PaddedStencil
    periodic: tuple[bool, bool, bool]
    layout: PaddedLayout


class HasRestriction(HasCells, HasLayout, HasVersion, Protocol):
    """Restriction to some of the cells, the others being AIR: blocks of unknowns."""

    def on_cells(self, cells: np.ndarray) -> HasRestriction:
        """Return an operator with the same coefficients on other cells.

        Padded as `cells` is. Coefficients elsewhere have no effect.
        """


class HasLowRankTerm(Operator, Protocol):
    """Sum A = G + U W U' of a stencil operator and a low-rank operator.

    Attributes:
        grid: G, an operator that has a stencil.
        low: U W U', a `wl.LowRankOperator` stored as G's fields are.
    """

    grid: HasStencil
    low: LowRankOperator


class HasApplyPlus(Operator, Protocol):
    """Fused A x + b, which saves one pass over memory per residual."""

    def apply_plus(self, x: DeviceArray, b: DeviceArray, out: DeviceArray) -> None:
        """Evaluate out = A x + b; flat stored fields of one type."""


class HasScale(Operator, Protocol):
    """Scale d of the natural residual d_i (x_i - clip(x_i - y_i / d_i, l_i, u_i)).

    Without it, d is estimated by 16 products.
    """

    def scale(self) -> np.ndarray | None:
        """Return d > 0 as a flat stored field; None: d is to be estimated.

        In units of y over those of x.
        """


class HasFloatingComponents(Operator, Protocol):
    """Components of unknowns on which A is singular (constants are its null space).

    They are projected out, or b is INFEASIBLE there.
    """

    def floating_components(self, scratch: Scratch | None = None) -> FloatingComponents | None:
        """Return the floating components, None if there are none.

        See `warp_lcp.operators.components.FloatingComponents`.

        Args:
            scratch: stored fields, of 4-byte elements and of bytes, that may be overwritten; None:
                there are none.
        """


class HasStorageRounding(Operator, Protocol):
    """Rounding of stored entries.

    A tolerance below it applies only to the stored A, and the status is FLOOR.
    """

    def storage_rounding(self) -> float:
        """Return the largest relative rounding of the data of A; 0: none.

        Relative to the values given in float64.
        """


class HasReplica(Operator, Protocol):
    """Copies of an operator in their own memory, which later take others of its form.

    Attributes:
        form: sizes, types and numbers of operators that can take each other's data; None: this
            operator has no copies.
    """

    @property
    def form(self) -> Hashable | None: ...  # noqa: D102

    def replica(self) -> Operator:
        """Return a copy in its own memory."""

    def copy_from(self, other: Operator) -> None:
        """Copy the data of an operator of the same form."""


class HasPrincipalSystem(Operator, Protocol):
    """Principal systems, as operators."""

    def masked(self, free: Values, shift: Values | None = None) -> Operator:
        """Return P A P + P D P with P the restriction to `free`, D = diag(shift)."""


class HasHostDiagonal(Operator, Protocol):
    """Diagonal in memory of the host."""

    def host_diagonal(self) -> np.ndarray:
        """Return the diagonal, shape (n,)."""


class HasCoefficients(Operator, Protocol):
    """Derivatives of a scalar by the data of A, for `wl.vjp`."""

    def coefficient_gradient(self, multiplier: DeviceArray, x: DeviceArray) -> Derivatives:
        """Return the derivatives of mu'A x by the constructor's arguments, by name.

        Each has the shape that was given, as a wp.float64 array on A's device, or is a number where
        a number was given; None where nothing was. Those of a matrix are on its pattern.

        Args:
            multiplier: mu, stored field, wp.float64, 0 off the unknowns.
            x: likewise.
        """


FAMILIES = {"dense": "wl.DenseOperator", "sparse": "wl.SparseOperator", "grid": "wl.GridPoisson"}
# Name of each, and our own families that have it.
CAPABILITIES: dict[type[Operator], tuple[str, tuple[str, ...]]] = {
    HasRows: ("rows", ("dense", "sparse")),
    HasSweep: ("a sweep", ("dense", "sparse", "grid")),
    HasStencil: ("a stencil", ("grid",)),
    HasRestriction: ("blocks", ("grid",)),
    HasLowRankTerm: ("a stencil and columns", ()),
    HasLayout: ("a layout", ("dense", "sparse", "grid")),
    HasVersion: ("a version", ("sparse", "grid")),
    HasCells: ("cells", ("grid",)),
    HasApplyPlus: ("sums with products", ("sparse", "grid")),
    HasScale: ("a scale", ("dense", "sparse")),
    HasFloatingComponents: ("components", ("grid",)),
    HasStorageRounding: ("the rounding of storage", ("dense", "sparse", "grid")),
    HasCoefficients: ("coefficients", ("dense", "sparse", "grid")),
}


@cache
def members(capability: type[Operator]) -> tuple[str, ...]:
    """Return the names of a capability's members besides those of `Operator`.

    For `Operator` its own members.
    """
    bases = [
        base for base in reversed(capability.__mro__) if base not in (object, Generic, Protocol)
    ]
    own = [base for base in bases if base is not Operator] or bases
    return tuple(
        dict.fromkeys(
            name
            for base in own
            for name in (*base.__annotations__, *vars(base))
            if not name.startswith("_")
        )
    )


def missing(A: object, capability: type[Operator]) -> list[str]:
    """Return the members of a capability that an object does not have."""
    return [name for name in members(capability) if not hasattr(A, name)]


def has(A: object, capability: type[Capability]) -> TypeGuard[Capability]:
    """Return whether an operator has a capability: all of its members.

    `isinstance` of protocols would take 10 us.
    """
    return not missing(A, capability)


@dataclass(frozen=True)
class Declarations:
    """Declarations of a method: class attributes, with defaults for missing ones.

    Attributes:
        form: of A that it works on, for messages.
        problems: class of problems that it solves; None: LCP.
        supports: capabilities of an operator of which it needs one; empty: products suffice.
        affine_bounds: whether it takes bounds that are affine in x.
        preconditioned: whether it uses the problem's preconditioner.
        distributed: whether it works on several ranks.
        definite: whether it needs a positive definite A.
        any_numbering: whether the order of unknowns may be changed for it.
        most_unknowns: largest number of unknowns; None: any.
    """

    form: str = ""
    problems: type | None = None
    supports: tuple[type[Operator], ...] = ()
    affine_bounds: bool = False
    preconditioned: bool = False
    distributed: bool = False
    definite: bool = False
    any_numbering: bool = False
    most_unknowns: int | None = None


class MethodChain:
    """Base of methods that hand over to others; its declarations are the first method's."""

    @property
    def first(self) -> Solver:
        """The method that begins."""
        raise NotImplementedError


def declared(method: Solver | type) -> Declarations:
    """Return the declarations of a method, or of its class."""
    while isinstance(method, MethodChain):
        method = method.first
    return _declared_by(method if isinstance(method, type) else type(method))


@cache
def _declared_by(kind: type) -> Declarations:
    def of(name: str, usual: Declaration) -> Declaration:
        value: Declaration = getattr(kind, name, usual)
        return value

    own = Declarations()
    return Declarations(
        form=of("form", own.form),
        problems=of("problems", own.problems),
        supports=of("supports", own.supports),
        affine_bounds=of("affine_bounds", own.affine_bounds),
        preconditioned=of("preconditioned", own.preconditioned),
        distributed=of("distributed", own.distributed),
        definite=of("definite", own.definite),
        any_numbering=of("any_numbering", own.any_numbering),
        most_unknowns=of("most_unknowns", own.most_unknowns),
    )


def version_of(A: Operator) -> int | None:
    """Return the version of an operator, None if it has no version."""
    return A.version if has(A, HasVersion) else None


def asks_beyond_storage(A: Operator, share: float) -> bool:
    """Return whether a tolerance is below the storage rounding of A's entries.

    `share` is a relative tolerance; entries stored in float32 are rounded.
    """
    return share < FLOAT32_ROUNDING and has(A, HasStorageRounding) and share < A.storage_rounding()


def layout_of(A: Operator) -> Layout:
    """Return the layout of an operator's fields; plain arrays without a layout."""
    return A.layout if has(A, HasLayout) else Layout(A.shape, A.device)


def takes(method: Solver | type, A: Operator) -> bool:
    """Return whether a method, or its class, takes an operator.

    A must have one of the capabilities in `supports`, if that names any.
    """
    own = declared(method)
    return own.problems is None and (
        not own.supports or any(has(A, capability) for capability in own.supports)
    )


def families(method: Solver | type) -> set[str]:
    """Return the families of our own operators that a method, or its class, takes.

    "dense", "sparse", "grid"; empty for methods of other problems.
    """
    own = declared(method)
    if own.problems is not None:
        return set()
    return (
        {family for capability in own.supports for family in CAPABILITIES[capability][1]}
        if own.supports
        else set(FAMILIES)
    )


def described(*capabilities: type[Operator]) -> str:
    """Return the names of capabilities, and the operators that have them.

    For messages.
    """
    return " or ".join(
        name + (f" ({', '.join(FAMILIES[family] for family in having)})" if having else "")
        for name, having in (CAPABILITIES[capability] for capability in capabilities)
    )


def check_taken(method: Solver, A: Operator) -> None:
    """Check that a method takes an operator.

    Raises:
        ValueError: it does not; the message names the missing capabilities, and methods
            without requirements.
    """
    if not takes(method, A):
        needed = described(*declared(method).supports)
        advice = (
            "use MinimumMapNewton, or ProjectedJacobi where bounds are affine in x, which "
            "need only products"
        )
        raise ValueError(
            f"{type(method).__name__} needs an operator with {needed}; "
            f"{type(A).__name__} has none: {advice}"
        )


__getattr__ = renamed_names(
    __name__,
    AppliesPlus="HasApplyPlus",
    HasBlocks="HasRestriction",
    HasColumns="HasLowRankTerm",
    NamesComponents="HasFloatingComponents",
    Relaxes="HasSweep",
    StoresRounded="HasStorageRounding",
    Versioned="HasVersion",
)
