"""Collective blocks: an error on one rank is raised on all, with its rank."""

import pytest

from warp_lcp.distributed.collective import Collective

BLOCKS = """
    import sys
    from warp_lcp.distributed import collective as collectives
    from warp_lcp.distributed.ranks import Ranks

    ranks = Ranks.world()
    collectives.PATIENCE = 1.0
    collective = collectives.Collective(ranks, (OSError, ValueError), \
lambda text: sys.stderr.write(text + "\\n"))

    def one():
        with collective.together():
            if ranks.rank == 1:
                raise OSError(28, "No space left")

    def in_another():
        with collective.together(), collective.together():
            if ranks.rank == 1:
                raise ValueError("inside")

    def between():
        with collective.together():
            if ranks.rank == 1:
                raise ValueError("not inside")
            with collective.together():
                pass

    def bug():
        with collective.together():
            if ranks.rank == 1:
                {}["key"]

    def all_alike():
        with collective.together():
            raise ValueError("wrong")

    def all_but_one():
        with collective.together():
            if ranks.rank:
                raise ValueError("wrong")

    def led():
        with collective.root_only():
            if ranks.is_root:
                raise ValueError("from the first")

    def none():
        with collective.together():
            assert collective.exchange(ranks.rank) == [0, 1, 2]
            assert collective.share(ranks.rank) == 0

    for block in (one, in_another, between, bug, all_alike, all_but_one, led, none):
        try:
            block()
            text = "fine"
        except BaseException as error:
            text = f"{type(error).__name__} {error} {getattr(error, 'errno', '')} \
{getattr(error, '__notes__', '')} {collective.failed}"
        print(f"{ranks.rank} {block.__name__}: {text.strip()}\\n", end="")
"""
ALONE = """
    import sys
    from warp_lcp.distributed import collective as collectives
    from warp_lcp.distributed.ranks import Ranks

    ranks = Ranks.world()
    collectives.PATIENCE = 1.0
    with collectives.Collective(ranks, (ValueError,), \
lambda text: sys.stderr.write(text + "\\n")).together():
        if ranks.rank == 1:
            raise ValueError("left alone")
        ranks.sum(1)  # without rank 1
    print("done")
"""
EXPECTED = {
    "one": "OSError rank 1: [Errno 28] No space left 28  [1]",
    "in_another": "ValueError rank 1: inside   [0, 1, 2]",
    "between": "ValueError rank 1: not inside   [0, 1, 2]",
    "all_alike": "ValueError wrong   [0, 1, 2]",
    "all_but_one": "ValueError ranks 1, 2: wrong   [1, 2]",
    "led": "ValueError from the first   [0]",
    "none": "fine",
}


def test_collective_blocks_end_alike_on_all_ranks(mpi):
    found = mpi(3, BLOCKS).stdout.splitlines()
    for name, expected in EXPECTED.items():
        assert {line for line in found if f" {name}:" in line} == {
            f"{rank} {name}: {expected}" for rank in range(3)
        }
    bug = {line for line in found if " bug:" in line}
    others = {f"{rank} bug: RankFailed rank 1: KeyError: 'key'   [1]" for rank in (0, 2)}
    assert bug == others | {"1 bug: KeyError 'key'  ['on rank 1 of 3'] [1]"}


def test_a_rank_without_a_collective_partner_aborts_all(mpi):
    done = mpi(3, ALONE, exit_code=1)
    assert "rank 1 of 3: left alone\nall ranks are aborted" in done.stderr
    assert "done" not in done.stdout


def test_one_process_needs_no_communication():
    alone = Collective.for_one_process()
    with pytest.raises(KeyError), alone.together():
        {}["key"]
    with pytest.raises(OSError, match="full") as found, alone.root_only():
        raise OSError("full")
    assert str(found.value) == "full"
    with alone.together():
        assert alone.exchange(7) == [7]
    assert alone.failed == []
