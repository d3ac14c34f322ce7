"""Objects of PETSc that Python ends on one rank earlier than on another do no harm."""

PROGRAM = """
    import gc
    import numpy as np
    from petsc4py import PETSc
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
    print(f"made{ranks.rank} ", end="")
"""


def test_a_rank_without_objects_makes_the_next_one(mpi):
    assert sorted(mpi(2, PROGRAM, seconds=30.0).stdout.split()) == ["made0", "made1"]
