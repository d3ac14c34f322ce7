"""Migration of passive particles, which need neither ghosts nor an order of sums."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from warp_lcp.distributed.particle_pieces import cells_of
from warp_lcp.material.particle_pieces import Piece, passive_arrays

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain


def send_to_owners(
    part: Subdomain, arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray] | None:
    """Send particles to the ranks that own their cells; collective.

    A particle may go to any rank. The ranks first gather how many particles each sends to each
    other, so that messages pass only between ranks of which one sends some.

    Args:
        part: the subdomain of this rank.
        arrays: `position` [m] among them, float32 of shape (n, 3).

    Returns:
        The particles of this rank: those that stay in their order, then those that arrive, by rank.
        None if none leaves and none arrives.
    """
    ranks = part.ranks
    owner = part.owners(cells_of(part, arrays["position"]))
    traffic = ranks.gather(np.bincount(owner, minlength=ranks.size))
    own = ranks.rank
    partners = [
        rank
        for rank in range(ranks.size)
        if rank != own and (traffic[own, rank] or traffic[rank, own])
    ]
    if not partners:
        return None
    # A row of a message has all arrays of a particle.
    rows = np.concatenate(list(arrays.values()), axis=1)
    incoming = part.mailbox.swap({rank: rows[owner == rank].ravel() for rank in partners})
    width = rows.shape[1]
    joined = np.concatenate(
        [rows[owner == own], *(received.reshape(-1, width) for received in incoming)]
    )
    columns = np.split(joined, len(arrays), axis=1)
    return {
        name: np.ascontiguousarray(column) for name, column in zip(arrays, columns, strict=True)
    }


def rows_of_pieces(
    part: Subdomain, pieces: Sequence[Piece], names: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return the passive particles of pieces that lie in this rank's box; collective.

    Args:
        part: the subdomain of this rank.
        pieces: of all ranks of a run.
        names: of arrays, float32 of shape (n, 3); the first one has the positions [m].

    Raises:
        ValueError: as of `passive_arrays`; on all ranks.
    """
    with part.decomposition.collective.root_only():
        found: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for piece in pieces:
            arrays = passive_arrays(piece, names)
            inside = part.owners(cells_of(part, arrays[names[0]])) == part.ranks.rank
            for name, values in arrays.items():
                found[name].append(values[inside])
        return {name: np.concatenate(values) for name, values in found.items()}
