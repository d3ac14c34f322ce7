"""The start of Lemke and Howson's method, for bimatrix games, on which Lemke's own start ends in a ray at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_lcp.solvers.lemke import Basis


def strategies(M: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the two players' unknowns if M = [[0, E], [F', 0]], E > 0, F > 0, q < 0 in some order: a bimatrix game of costs."""
    if not (q < 0).all() or (M.diagonal() != 0).any():
        return None
    own = M[0] == 0
    first, second = np.flatnonzero(own), np.flatnonzero(~own)
    within = [M[np.ix_(player, player)] for player in (first, second)]
    across = [M[np.ix_(*players)] for players in ((first, second), (second, first))]
    return (first, second) if all((A == 0).all() for A in within) and len(second) and all((A > 0).all() for A in across) else None


def start_game(basis: Basis) -> bool:
    """Begin where the first player's first strategy is answered best; return False, and change nothing, if this is no game.

    w = q + M z. With d > 0 z0 makes all w >= 0, the first complement that enters then meets no row, as its block of M is 0: a ray. Lemke and
    Howson begin with z_k alone, as large as makes w >= 0 for the other player, w_s = 0 there; then z_s, as large as makes w >= 0
    for the first one, w_r = 0 there. That is a feasible basis, complementary but for pair k; it is the solution if r = k, else z_r enters,
    and the path ends where a variable of pair k leaves. As E, F > 0 it meets no ray.
    """
    players = strategies(basis.M, basis.q)
    if players is None:
        return False
    m, pair = basis.m, int(players[0][0])
    entering = pair
    for rows in reversed(players):
        sizes = -basis.q[rows] / basis.M[rows, entering]
        row = int(rows[np.flatnonzero(sizes >= sizes.max())[-1]])  # of ties the last: the others' rows stay lexicographically positive
        basis.exchange(row, m + entering)
        entering = row
    basis.ends = (pair, m + pair)
    basis.entering = -1 if entering == pair else m + entering
    return True
