"""Migration of a state's pieces to the ranks of new boxes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from warp_lcp.distributed.decomposition import CellBox
from warp_lcp.distributed.particle_pieces import cells_of
from warp_lcp.material.particle_pieces import Piece, fields_of

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain


def migrate(piece: Piece, particles: Sequence[str], before: Subdomain, now: Subdomain) -> Piece:
    """Send pieces of particles to the ranks of new boxes; collective.

    Args:
        piece: this rank's, of the part `before`.
        particles: names of the particles' arrays.
        before: the part that the piece belongs to.
        now: the part with the new boxes of the same ranks.

    Returns:
        The piece of this rank's new box.
    """
    own_rank, old, new = now.ranks.rank, before.decomposition.boxes, now.decomposition.boxes

    def gives(giver: int, taker: int) -> bool:  # particles migrate when a step begins
        return now.decomposition.boxes_overlap(old[giver].grown(before.layers), new[taker])

    other_ranks = [
        rank
        for rank in range(now.ranks.size)
        if rank != own_rank and (gives(own_rank, rank) or gives(rank, own_rank))
    ]
    owner = now.owners(cells_of(now, piece["position"]))
    new_piece = {**piece, "box": np.array([now.box.low, now.box.high])}
    for name in (*particles, "place"):
        values = np.asarray(piece[name])
        incoming = now.mailbox.swap({rank: values[owner == rank].ravel() for rank in other_ranks})
        new_piece[name] = np.concatenate(
            [
                values[owner == own_rank],
                *(received.reshape(-1, *values.shape[1:]) for received in incoming),
            ]
        )
    for name, values in fields_of(piece).items():
        new_piece[name] = np.zeros((*values.shape[:-3], *now.box.counts[::-1]), dtype=values.dtype)
        sent = {
            rank: _cut_out(values, old[own_rank], new[rank]) for rank in (own_rank, *other_ranks)
        }
        for rank, received in zip(
            (own_rank, *other_ranks), [sent.pop(own_rank), *now.mailbox.swap(sent)], strict=True
        ):
            box = old[rank].common(new[own_rank])
            if box.cells:
                new_piece[name][..., *box.moved(now.box.low, -1).slices] = received.reshape(
                    *values.shape[:-3], *box.counts[::-1]
                )
    return new_piece


def _cut_out(values: np.ndarray, box: CellBox, other: CellBox) -> np.ndarray:
    """Return the values of a box's cells that lie in another box, too, flat."""
    shared = box.common(other)
    return (
        values[..., *shared.moved(box.low, -1).slices].ravel()
        if shared.cells
        else values[:0].ravel()
    )


def cuts_of(pieces: Sequence[Piece], part: Subdomain) -> list[list[int]] | None:
    """Return the boxes' sizes in pieces, in cells along x, y, z, if usable.

    Returns None if the ranks cannot have the same boxes.

    Args:
        pieces: of all ranks, in their order.
        part: the subdomain of this rank.
    """
    now = part.decomposition
    if len(pieces) != now.ranks.size or any("box" not in piece for piece in pieces):
        return None
    boxes = [CellBox.of(*piece["box"]) for piece in pieces]
    cuts = [
        np.diff([*sorted({box.low[axis] for box in boxes}), n]).tolist()
        for axis, n in enumerate(now.counts)
    ]
    fits = math.prod(map(len, cuts)) == len(boxes) and all(
        len(cut) == 1 or min(cut) >= part.layers for cut in cuts
    )
    return cuts if fits and now.repartition(cuts).boxes == boxes else None
