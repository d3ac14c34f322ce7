"""Assignment of a machine's devices to its ranks, in turns."""

import pytest

from warp_lcp.distributed.ranks import device_by_number


@pytest.mark.parametrize(
    ("name", "number", "found", "expected"),
    [
        (None, 1, [], "cpu"),
        (None, 1, ["cuda:0"], "cuda:0"),
        ("cpu", 0, ["cuda:0"], "cpu"),
        ("cuda", 3, ["cuda:0", "cuda:1"], "cuda:1"),
        ("cuda:1", 0, ["cuda:0", "cuda:1"], "cuda:1"),
    ],
)
def test_devices_are_assigned_round_robin(name, number, found, expected):
    assert device_by_number(name, number, found) == expected


@pytest.mark.parametrize(("name", "choices"), [("cuda", "cpu"), ("cuda:0", "cpu"), ("tpu", "cpu")])
def test_a_missing_device_is_named(name, choices):
    with pytest.raises(
        ValueError,
        match=f"--device {name}: there is no such device on this machine; choose from {choices}",
    ):
        device_by_number(name, 0, [])


def test_ranks_of_one_machine_count_through_its_devices(mpi):
    text = """
    import warp as wp
    from warp_lcp.distributed import ranks as devices
    from warp_lcp.distributed.ranks import Ranks
    wp.config.log_level = wp.LOG_ERROR
    # Without a GPU at hand.
    devices.device_by_number = lambda name, number, found: f"{name} {number}"
    ranks = Ranks.world()
    print(f"{ranks.rank}: {devices.device_of_rank(ranks, 'cuda')}\\n", end="")
    """
    lines = mpi(3, text).stdout.split("\n")
    assert sorted(line for line in lines if ": cuda" in line) == [
        "0: cuda 0",
        "1: cuda 1",
        "2: cuda 2",
    ]
