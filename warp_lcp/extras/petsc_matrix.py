"""Grid operator as a PETSc Mat, and multigrid cycle as a PETSc PC; matrix-free.

They serve KSP, SNES and TAO. Vectors are those of a DMDA with one degree of freedom a cell: each
rank's cells one after another, x fastest, without ghost cells. Warp reads and writes them in
PETSc's memory. Fields have a ring of ghost cells, so each product and each cycle costs two strided
copies.
"""

from __future__ import annotations

import math
import weakref
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import warp as wp

from warp_lcp.distributed.launch import petsc
from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.multigrid.multiple_semicoarsening import make_hierarchy
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.problem.operator_protocol import HasStencil

if TYPE_CHECKING:
    from mpi4py import MPI
    from petsc4py import PETSc

    from warp_lcp.distributed.decomposition import Decomposition

ObjectT = TypeVar("ObjectT", bound="PETSc.Object")
KERNELS = KernelFile(Path(__file__).parent / "headers/petsc_matrix.h")
ENTER = KERNELS["vector_copies.enter"]
LEAVE = KERNELS["vector_copies.leave"]
TRUE_RESIDUAL = frozenset(
    {"cg", "cgne", "fcg", "pipefcg", "groppcg", "pipecg", "bcgs", "tfqmr", "fgmres", "richardson"}
)
"""Methods of KSP that can monitor b - A x; others compute other norms only."""


class VectorCopies:
    """Copies between PETSc's vectors and the stored fields of a stencil's grid.

    Args:
        stencil: of the rank's cells; cells with a nonzero diagonal are unknowns. Read at every
            copy.
        comm: PETSc's communicator of the vectors, each rank having its own cells.

    Attributes:
        sizes: local and global length of the vectors, as PETSc takes them.
    """

    def __init__(self, stencil: PaddedStencil, comm: MPI.Comm | PETSc.Comm) -> None:
        self.stencil, self.comm, self.device = stencil, comm, stencil.device
        self._n = math.prod(stencil.padding.counts)
        self.sizes = self._n, None  # PETSc computes the sum over ranks
        counts = stencil.padding.counts
        dense = Rows.strided(self._n, self.device, (0, counts[1] * counts[2], counts[2]), counts)
        self._rows = Rows.of(stencil.padding, self.device).beside(dense, (1, 1, 1))
        staged = self.device.is_cuda  # PETSc's vectors are in host memory
        self._staging = (
            [wp.zeros(self._n, dtype=wp.float64, device=self.device) for _ in range(2)]
            if staged
            else []
        )

    def vector(self) -> PETSc.Vec:
        """Return a vector of zeros."""
        PETSc = petsc()
        v = PETSc.Vec().create(self.comm)
        v.setSizes(self.sizes)
        v.setType(PETSc.Vec.Type.STANDARD)
        return v

    def enter(self, v: PETSc.Vec, field: DeviceArray, scale: float = 1.0) -> None:
        """Set the field to scale v on the unknowns, and to 0 on the other cells.

        Ghost cells keep their values.
        """
        values = v.getArray(readonly=True)  # PETSc counts accesses: this one ends with the array
        ENTER.bind(
            self._rows, v=self._view(values, 0), d=self.stencil.d, x=field, scale=scale
        ).launch()

    def leave(
        self, field: DeviceArray, outside: PETSc.Vec | None, v: PETSc.Vec, scale: float = 1.0
    ) -> None:
        """Set v to scale times the field on the unknowns.

        On the other cells v becomes `outside`, or 0 if that is None.
        """
        outside_values = None if outside is None else outside.getArray(readonly=True)
        values = v.getArray()
        outside_view, target = (
            None if outside_values is None else self._view(outside_values, 0),
            self._view(values, 1),
        )
        LEAVE.bind(
            self._rows, x=field, d=self.stencil.d, others=outside_view, v=target, scale=scale
        ).launch()
        if self._staging:
            values[:] = target.numpy()

    def _view(self, values: np.ndarray, buffer: int) -> DeviceArray:
        """Return a vector's memory on the device: itself on the CPU, a copy on a GPU."""
        if not self._staging:
            return wp.array(
                ptr=values.ctypes.data, dtype=wp.float64, shape=self._n, device=self.device
            )
        self._staging[buffer].assign(values)
        return self._staging[buffer]


class StencilMatrix:
    """Product with a stencil, as the context of a Mat of PETSc's type `python`.

    B = A on the cells with a diagonal that is not 0, for x = 0 on the others; the identity on the
    others. A stencil whose diagonal a free set I has masked thus gives B = D_I A D_I + D_(not I),
    symmetric if A is, and on ranks the same matrix as on one.

    Args:
        stencil: read at each product.
        copies: of its grid.
    """

    def __init__(self, stencil: PaddedStencil, copies: VectorCopies) -> None:
        self._stencil, self._copies = stencil, copies
        self._x, self._y = (
            zeros(stencil.padding.size, wp.float64, stencil.device) for _ in range(2)
        )

    def as_mat(self) -> PETSc.Mat:
        """Return the product as a Mat of PETSc."""
        matrix = petsc().Mat().createPython((self._copies.sizes,) * 2, self, comm=self._copies.comm)
        matrix.setOption(petsc().Mat.Option.SYMMETRIC, True)
        matrix.setUp()
        return matrix

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write the product B x to y."""
        self._copies.enter(x, self._x)
        self._stencil.product(self._x, self._y)
        self._copies.leave(self._y, x, y)

    multTranspose = mult  # noqa: N815  # PETSc's name; B is symmetric

    def createSubMatrix(  # noqa: N802  # PETSc's name
        self, matrix: PETSc.Mat, rows: PETSc.IS, columns: PETSc.IS, out: PETSc.Mat | None = None
    ) -> PETSc.Mat:
        """Return the submatrix of B on some rows and columns.

        Its products are those of B with zeros elsewhere. Methods for bounds solve on free cells.
        """
        return petsc().Mat().createSubMatrixVirtual(matrix, rows, columns)

    def getDiagonal(self, matrix: PETSc.Mat, d: PETSc.Vec) -> None:  # noqa: N802  # PETSc's name
        """Write the diagonal of B to d."""
        padding = self._stencil.padding
        own = (
            self._stencil.d.numpy().reshape(padding.shape)[1:-1, 1:-1, 1:-1].astype(np.float64)
            * self._stencil.unit
        )
        d.setArray(np.where(own == 0, 1.0, own).ravel())


class CyclePreconditioner:
    """One linear multigrid cycle, as the context of a PC of PETSc's type `python`.

    The preconditioner is symmetric positive definite.

    Args:
        hierarchy: rebuilt for the free set by the caller.
        copies: of its finest grid.
    """

    def __init__(self, hierarchy: Hierarchy, copies: VectorCopies) -> None:
        self._hierarchy, self._copies = hierarchy, copies

    def apply(self, preconditioner: PETSc.PC, r: PETSc.Vec, z: PETSc.Vec) -> None:
        """Apply the preconditioner: Z = one cycle on r.

        It is the identity on cells that are held.
        """
        finest = self._hierarchy.finest
        # Corrections may be float32: r is scaled to length 1. PETSc caches the norms that its KSP
        # has requested.
        size = r.norm()
        if size == 0 or not math.isfinite(size):
            r.copy(z)
            return
        self._copies.enter(r, finest.b, 1 / size)
        self._hierarchy.cycle.run()
        self._copies.leave(finest.x, r, z, size)

    applyTranspose = apply  # noqa: N815  # PETSc's name


class PetscGrid:
    """Grid operator and multigrid cycle as PETSc objects.

    PETSc's own methods then work on the operator, matrix-free: KSP with the cycle; SNES's
    vinewtonrsls and TAO's tron and gpcg, which take free sets out of the operator themselves, with
    `-pc_type none` or jacobi. Everything here is collective where ranks share the operator. Keep
    the grid while PETSc uses its objects.

    Grids whose FLUID cells touch neither AIR nor a shift are singular: set the constants as the
    null space of PETSc's matrices.

    Args:
        A: the operator, of one process or distributed over ranks.
        hierarchy: of A, its finest diagonal filled by the caller; None: one of its own, for all
            unknowns until `set_free_set` is called.
        real: type in which its cycles work.
        cycle: settings of the cycles.

    Attributes:
        operator: A as a Mat, the identity on cells that are no FLUID.
        matrix: A on the free set as a Mat, the identity on other cells; in the hierarchy's storage,
            so with coefficients of type `real`.
        cycle: context of a PC on the free set.
        copies: between vectors and stored fields.

    Example:
        >>> from warp_lcp.distributed import PetscGrid# doctest: +SKIP
        >>> grid = PetscGrid(A)  # doctest: +SKIP
        >>> b, x, ksp = grid.vector(values), grid.vector(), grid.solver()  # doctest: +SKIP
        >>> ksp.solve(b, x)  # doctest: +SKIP
        >>> print(ksp.getIterationNumber(), grid.field(x).shape)  # doctest: +SKIP
    """

    def __init__(
        self,
        A: HasStencil,
        hierarchy: Hierarchy | None = None,
        *,
        real: type = wp.float32,
        cycle: CycleSettings | None = None,
    ) -> None:
        self._A, comm = A, communicator(A)
        # Objects that ranks share are destroyed when all ranks have released them and PETSc
        # collects garbage.
        petsc().garbage_cleanup(comm)
        self._keep_alive: list[PETSc.Object] = []
        weakref.finalize(self, _release, self._keep_alive).atexit = False
        self.hierarchy = hierarchy or make_hierarchy(A.stencil, real, bounded=False, settings=cycle)
        finest = self.hierarchy.finest.stencil
        self.copies = VectorCopies(finest, comm)
        self.matrix = self._keep(StencilMatrix(finest, self.copies).as_mat())
        self.cycle = CyclePreconditioner(self.hierarchy, self.copies)
        if hierarchy is None:
            self.set_free_set(A.layout.load(np.ones(A.shape), wp.uint8))

    @cached_property
    def operator(self) -> PETSc.Mat:
        """Matrix of A on all unknowns, built at first access."""
        return self._keep(
            StencilMatrix(self._A.stencil, VectorCopies(self._A.stencil, self.copies.comm)).as_mat()
        )

    def vector(self, field: np.ndarray | None = None) -> PETSc.Vec:
        """Return a vector with the values of a field of A's shape; zeros if None."""
        v = self.copies.vector()
        if field is not None:
            v.setArray(np.ascontiguousarray(field, dtype=np.float64).ravel())
        return v

    def field(self, v: PETSc.Vec) -> np.ndarray:
        """Return the values of a vector as a field of A's shape, a copy."""
        return v.getArray(readonly=True).reshape(self._A.shape).copy()

    def set_free_set(self, free: DeviceArray) -> None:
        """Set another free set, a stored uint8 field; other unknowns are held fixed."""
        self.hierarchy.mask_diagonal(self._A.stencil.d, free)
        self.hierarchy.rebuild_changed()
        self.matrix.stateIncrease()

    def solver(self, prefix: str = "") -> PETSc.KSP:
        """Return a KSP on `matrix`: conjugate gradients preconditioned by a cycle.

        PETSc options with the given prefix change it.

        Args:
            prefix: of the options, such as "wall_" for `-wall_ksp_type`.
        """
        PETSc = petsc()
        ksp = PETSc.KSP().create(self.copies.comm)
        ksp.setOptionsPrefix(prefix)
        ksp.setOperators(self.matrix)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.getPC().setType(PETSc.PC.Type.PYTHON)
        ksp.getPC().setPythonContext(self.cycle)
        ksp.setFromOptions()
        if ksp.getType() in TRUE_RESIDUAL and not PETSc.Options(prefix).hasName("ksp_norm_type"):
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        self._keep(ksp.getPC())
        return ksp

    def _keep(self, thing: ObjectT) -> ObjectT:
        """Return a proxy of a Python object with one reference more.

        The reference lives as long as this grid. At the end of a program PETSc destroys its
        remaining objects after Python has ended, and must not destroy these.
        """
        thing.incRef()
        self._keep_alive.append(thing)
        return thing


def _release(kept: list[PETSc.Object]) -> None:
    """Make PETSc destroy objects that are no longer referenced."""
    for thing in kept:
        thing.decRef()


def communicator(A: HasStencil) -> MPI.Comm | PETSc.Comm:
    """Return PETSc's or mpi4py's communicator of the ranks that share an operator."""
    decomposition: Decomposition | None = getattr(A, "decomposition", None)
    return petsc().COMM_SELF if decomposition is None else decomposition.ranks.comm
