"""Liquid on the ranks of MPI: the domain is cut into boxes, one a rank, and particles belong to the rank whose box they are in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fluids.scene import LiquidScene
from fluids.simulator import LiquidSimulation
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.driver.scene import Scene

Piece = Mapping[str, np.ndarray]  # what one rank has of a simulation's state


class DistributedLiquid(LiquidSimulation):
    """A rank's part of a liquid in progress; implements `warp_lcp.driver.simulator.Simulation`.

    `stable_dt`, `step`, `restore_pieces` are collective and give every rank the same numbers, or raise the same kind of error on all:
    rows of the log are of the whole liquid. `frame` shows this rank's particles and cells, with positions and cells' numbers of the whole
    domain; `frame`, `piece_state`, `columns` and `notes` ask nobody.
    """

    def piece_state(self) -> dict[str, np.ndarray]:
        """Return this rank's part of the state, without pickles, in the whole domain's coordinates.

        Names and shapes: `box` int64 (2, 3), the low and high (exclusive) cell x, y, z of this rank; `counts` int64 (3,), the whole grid's;
        `time`, `step_count`, `pressure_dt`, `signature` as of `state`, `time_error` (2,), the same on all ranks; particles: `position`,
        `velocity`, `affine_0` ... float32 (n, 3) and `place` int64 (n,), their order; cells: `pressure` float64, `cells` int8, `contact`
        uint8, of the box, shape (nz, ny, nx).
        """
        raise NotImplementedError

    def restore_pieces(self, pieces: Sequence[Piece]) -> None:
        """Continue from the pieces of all ranks of a run on any number of ranks; each rank takes what lies in its box. Collective.

        Args:
            pieces: of `piece_state`, of all ranks, in any order. Of a piece that has nothing in this rank's box grown by a cell the arrays
                of particles and cells are not read.

        Raises:
            ValueError: the pieces do not belong to this scene, or do not cover the domain; on all ranks.
        """
        raise NotImplementedError


def create(scene: Scene, ranks: Ranks, *, device: str, folder: Path) -> DistributedLiquid:
    """Build this rank's part of a simulation of `scene`; collective.

    Args:
        scene: a LiquidScene, the same on all ranks.
        ranks: who share it.
        device: a Warp device's name.
        folder: where the files are that the scene names.

    Raises:
        ValueError: the scene cannot be simulated, or not on ranks; the message names the key and what is allowed. On all ranks.
    """
    if not isinstance(scene, LiquidScene):
        raise ValueError("scene.simulator: fluids needs a scene of liquid")
    raise NotImplementedError
