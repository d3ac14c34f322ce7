"""Stable radix sort of particle keys on the CPU."""

import warp as wp

from warp_lcp.grid import particles_kernels as kernels
from warp_lcp.kernels import Rows
from warp_lcp.kernels.recorded_arguments import Scalar


def digits_of(bits: int) -> tuple[int, int]:
    """Return the number of rounds of a radix sort, and the bits of a round."""
    # An even number of rounds, so that the last one ends in the keys' own array. 2048 digits of a
    # round stay in the L1 cache.
    rounds = 2 * -(-bits // 22)
    return rounds, -(-bits // rounds)


def sort_keys(
    keys: tuple[wp.array, wp.array],
    order: tuple[wp.array, wp.array],
    counts: wp.array,
    rows: Rows,
    pieces: int | Scalar,
    bits: int,
) -> None:
    """Launch the sort of keys in place on the CPU, by a radix sort that is stable.

    Args:
        keys: int32, not negative, and scratch memory of the same size.
        order: int32, which receives where each key was, and scratch memory.
        counts: int32, scratch memory for `pieces` of a round's digits and `APART` more.
        rows: rows of the keys, a piece a task.
        pieces: how many there are.
        bits: largest number of bits of a key.
    """
    device = counts.device
    rounds, each = digits_of(bits)
    (source_keys, sorted_keys), (moved_to, moved_from), before = keys, order[::-1], None
    for shift in range(0, rounds * each, each):
        digits = 1 << each
        kernels.SORT_COUNT.bind(
            rows, key=source_keys, counts=counts, digits=digits, shift=shift
        ).launch()
        kernels.SORT_BEGIN.bind(
            Rows.entries(1, device), counts=counts, digits=digits, pieces=pieces
        ).launch()
        kernels.SORT_PLACE.bind(
            rows,
            key=source_keys,
            order=before,
            sorted=sorted_keys,
            moved=moved_to,
            counts=counts,
            digits=digits,
            shift=shift,
        ).launch()
        source_keys, sorted_keys, before, moved_to, moved_from = (
            sorted_keys,
            source_keys,
            moved_to,
            moved_from,
            moved_to,
        )
