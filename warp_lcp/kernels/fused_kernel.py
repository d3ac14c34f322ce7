# mypy: ignore-errors
"""Fused kernels: stages that follow each other through memory, some planes apart."""

from warp_lcp.kernels.launch_graph import Launch, launch_now, perform
from warp_lcp.kernels.layout import copy_of, put
from warp_lcp.kernels.stencil_kernel import BoundKernel, StencilKernel
from warp_lcp.kernels.thread_pool import CELLS, SLABS, Operation, get_threads, team

LARGEST = 4  # most stages
# Least size of fused kernels' slabs: adjacent slabs finish shared planes together.
SLAB_PIECES, SLAB_PLANES = 4, 8


def slabs_of(planes: int, least: int, threads: int) -> tuple[int, int]:
    """Return the number of slabs, and the planes of each but the last.

    The planes of a slab are an even number, because a coarser plane stands for two.

    Args:
        planes: to cut, at least twice `least`.
        least: planes that a slab has at least.
        threads: that take them.
    """
    cuts = [
        (count, planes // count // 2 * 2)
        for count in range(2, min(planes // least, SLAB_PIECES * threads) + 1)
    ]
    # Planes of the thread that has the last slab, and of the busiest one.
    shares = [-(-count // threads) * each + planes - count * each for count, each in cuts]
    return max(cut for cut, share in zip(cuts, shares, strict=True) if share <= 1.1 * min(shares))


class FusedKernel:
    """Fused kernels: each runs some planes behind the one before.

    A CPU then streams through memory once. On CUDA they are separate launches.

    Args:
        name: of the kernel, as a stencil kernel has one.
        stages: at most four kernels, each with how many planes it is behind the first.

    Raises:
        ValueError: there are too many, or the first is behind.
    """

    def __init__(self, name: str, *stages: tuple[StencilKernel, int]) -> None:
        if not 0 < len(stages) <= LARGEST or stages[0][1] or min(lag for _, lag in stages) < 0:
            raise ValueError(
                f"{name}: expected 1 to {LARGEST} passes, 0 and more planes behind the first"
            )
        self.name, self.stages = name, stages

    def launch(self, *passes: BoundKernel | None, launch: Launch = launch_now) -> None:
        """Launch the stages, or record them; None leaves one out.

        Raises:
            TypeError: the kernels are others, or in another order, than declared.
            ValueError: threads share the rows of a stage otherwise, as those of a flat field.
        """
        declared = tuple(stage for stage, _ in self.stages)
        lagged_kernels = [
            (b, lag) for b, (_, lag) in zip(passes, self.stages, strict=False) if b is not None
        ]
        if len(passes) != len(declared) or any(
            b and b.form.declared is not stage for b, stage in zip(passes, declared, strict=True)
        ):
            raise TypeError(
                f"{self.name}: takes {', '.join(stage.name for stage in declared)}, in this order"
            )
        if not lagged_kernels:
            return
        if (
            lagged_kernels[0][0].rows.device.is_cuda
            or max(b.layout.slab for b, _ in lagged_kernels) > 1
        ):
            for bound, _ in lagged_kernels:
                bound.launch(launch)
            return
        if max([b.rows.single.chunks for b, _ in lagged_kernels]) > 1:
            raise ValueError(f"{self.name}: takes whole rows, not chunks of them")
        if team() is None:
            self._launch_planes(lagged_kernels, launch)
            return
        perform(self._operation(lagged_kernels), launch)

    def _launch_planes(self, lagged_kernels: list[tuple[BoundKernel, int]], launch: Launch) -> None:
        """Launch the stages plane by plane, in the order of `team.h` within a slab."""
        for turn in range(
            max(b.layout.planes for b, _ in lagged_kernels) + max(lag for _, lag in lagged_kernels)
        ):
            for bound, lag in lagged_kernels:
                L, i = bound.layout, turn - lag
                # Planes of the finer level that one of a coarser level stands for. The coarser
                # plane is processed with the last of them.
                finer = max(L.fz, 1)
                whole = finer == 1 or (i < L.n1 and ((i + 1) % finer == 0 or i == L.n1 - 1))
                if 0 <= (k := i // finer) < L.planes and whole:
                    there = put(copy_of(L), {"begin": k * L.rows, "end": (k + 1) * L.rows})
                    launch(
                        bound.form.kernel,
                        (1, 1, 1),
                        [there, bound.fields],
                        device=bound.rows.device,
                    )

    def _operation(self, lagged_kernels: list[tuple[BoundKernel, int]]) -> Operation:
        """Return the fused kernel for the thread pool, cut into slabs of planes."""
        layouts = [b.layout for b, _ in lagged_kernels]
        planes, most = max(L.planes for L in layouts), max(lag for _, lag in lagged_kernels)
        # Gaps between slabs must not overlap, and three planes lie between those that are kept.
        least = 2 * (max(SLAB_PLANES, 2 * most + 5) // 2 + 1)
        alone = (
            get_threads() == 1
            or any(L.turn or L.lift for L in layouts)
            or planes * max(L.rows * L.nx for L in layouts) < 2 * CELLS
        )
        slabs, each = (
            (1, planes) if alone or planes < 2 * least else slabs_of(planes, least, get_threads())
        )
        members = {}
        if slabs > 1:
            apart = max([lag for b, lag in lagged_kernels if b.form.declared.ring], default=0) + 1
            members = {"cut": each, "slabs": slabs, "apart": apart}
        stages = [
            b.stage(lag, **(members if b.form.declared.ring else {})) for b, lag in lagged_kernels
        ]
        return Operation(SLABS, stages, slabs, each, planes, most)
