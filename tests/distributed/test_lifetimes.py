"""PETSc objects that Python frees on one rank earlier than on another."""

PROGRAM = """
    import gc
    import numpy as np
    from petsc4py import PETSc
    from warp_lcp.distributed.decomposition import CellBox
    from warp_lcp.distributed.halo import star_forest
    from warp_lcp.distributed.ranks import Ranks

    ranks = Ranks.world()
    def make():
        forest = PETSc.SF().create(comm=ranks.comm)
        forest.setGraph(2, np.zeros(1, dtype=np.int32), np.array([[ranks.rank, 1]], dtype=np.int32))
        return forest

    kept = make()
    if ranks.is_root:
        del kept
        gc.collect()
    make()
    print(f"made{ranks.rank} ", end="", flush=True)

    boxes = [CellBox((0, 0, rank), (1, 1, rank + 1)) for rank in range(2)]
    forests = [star_forest(ranks, boxes, [box.grown(1) for box in boxes])]
    if ranks.is_root:
        forests.append(forests)
    del forests
    gc.collect()
    print(f"ended{ranks.rank} ", end="")
"""


def test_a_rank_without_objects_creates_the_next_one_and_all_ranks_end(mpi):
    assert sorted(mpi(2, PROGRAM, seconds=60.0).stdout.split()) == [
        "ended0",
        "ended1",
        "made0",
        "made1",
    ]
