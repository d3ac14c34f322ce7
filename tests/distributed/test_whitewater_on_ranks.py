"""Whitewater on ranks: the particles of one process, resume, limits and messages."""

from pathlib import Path

import numpy as np
import pytest
import whitewater_on_ranks
from liquids_on_ranks import advance
from ranks_in_turn import RankInTurn, on_ranks
from scipy.spatial import cKDTree
from test_shared_particles import cells_of, part_of, scattered
from whitewater_on_ranks import CASES, HALF, MOST, SPLASH, STEPS, foaming, gathered

from warp_lcp.distributed.ranks import Ranks
from warp_lcp.fluids import SIMULATOR, LiquidScene
from warp_lcp.fluids.whitewater import COLUMNS, STATE, oldest

PROGRAM = Path(whitewater_on_ranks.__file__)
TESTS = Path(__file__).parents[1]
PATHS = {"PYTHONPATH": f"{TESTS}:{TESTS.parent}:{Path(__file__).parent}"}


def one_process(name: str, steps: int):
    """Return the simulation of one process after some steps, and its log."""
    simulation = SIMULATOR.create(foaming(name), device="cpu", folder=Path())
    rows = advance(simulation, steps)
    return simulation, np.array([[row[column] for column in COLUMNS] for row in rows])


def alone(simulation) -> dict[str, np.ndarray]:
    return gathered(Ranks(RankInTurn(0, 1)), simulation)


@pytest.fixture(scope="module")
def folder(mpi_of_module):
    """Folder with the results of two and three ranks, and of resumed runs."""
    where = mpi_of_module.folder
    mpi_of_module(2, PROGRAM, "run,resume", where, environment=PATHS)
    mpi_of_module(3, PROGRAM, "run,resume", where, environment=PATHS)
    return where


@pytest.mark.parametrize("ranks", [2, 3])
@pytest.mark.parametrize("name", CASES)
def test_the_first_step_emits_what_one_process_emits(folder, name, ranks):
    simulation, _ = one_process(name, 1)
    expected, found = alone(simulation), np.load(folder / f"{name}_first_{ranks}.npz")
    assert len(expected["whitewater_position"]) > 10
    for array in STATE:
        np.testing.assert_allclose(found[array], expected[array], atol=1e-4)


@pytest.mark.parametrize("ranks", [2, 3])
@pytest.mark.parametrize("name", CASES)
def test_numbers_are_those_of_one_process(folder, name, ranks):
    """Liquids differ by rounding, so that a few particles may; none is lost or doubled."""
    simulation, log = one_process(name, STEPS)
    found = np.load(folder / f"{name}_{ranks}.npz")
    own = log[-1, :3].sum()
    assert len(found["whitewater_position"]) == pytest.approx(own, rel=0.02)
    np.testing.assert_allclose(
        found["logs"][:, :3].sum(axis=1), log[:, :3].sum(axis=1), rtol=0.005, atol=1
    )
    rows = np.column_stack([found[array] for array in STATE])
    assert len(np.unique(rows, axis=0)) == len(rows), "particles are doubled"
    # Position and age, where 1 s counts as 1 m.
    both = [
        np.column_stack([of["whitewater_position"], of["whitewater_state"][:, 0]])
        for of in (found, alone(simulation))
    ]
    assert (cKDTree(both[0]).query(both[1])[0] < 1e-3).mean() > 0.95
    if name == "few":
        assert own == MOST
        assert found["logs"][:, 3].sum() == pytest.approx(log[:, 3].sum(), rel=0.02)


@pytest.mark.parametrize("name", CASES)
def test_resumed_ranks_continue_alike(folder, name):
    whole = np.load(folder / f"{name}_2.npz")
    same, others = (np.load(folder / f"{name}_resumed_{ranks}.npz") for ranks in (2, 3))
    for array in STATE:
        np.testing.assert_allclose(same[array], whole[array], atol=1e-5)
    assert same["log"][:3].sum() == whole["logs"][-1, :3].sum()
    assert others["log"][:3].sum() == pytest.approx(whole["logs"][-1, :3].sum(), rel=0.02)


def test_one_process_and_ranks_continue_each_other(folder):
    pieces = [np.load(folder / f"splash_piece_2_{rank}.npz") for rank in range(2)]
    simulation, _ = one_process("splash", 1)
    simulation.restore_pieces(pieces)
    joined = np.concatenate([piece["whitewater_position"] for piece in pieces])
    np.testing.assert_array_equal(simulation.state()["whitewater_position"], joined)
    advance(simulation, STEPS - HALF)
    whole = np.load(folder / "splash_2.npz")["whitewater_position"]
    assert simulation.whitewater.particles.count == pytest.approx(len(whole), rel=0.02)
    single = SIMULATOR.create(
        foaming("splash"), device="cpu", folder=Path(), ranks=Ranks(RankInTurn(0, 1))
    )
    single.restore(simulation.state())
    for array, values in alone(simulation).items():
        np.testing.assert_array_equal(alone(single)[array], values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda piece: piece.pop("whitewater_state"), "lacks whitewater_state"),
        (
            lambda piece: piece.update(whitewater_velocity=piece["whitewater_velocity"][1:]),
            "whitewater_velocity is float32",
        ),
        (
            lambda piece: piece["whitewater_position"].__setitem__((0, 1), np.nan),
            "whitewater_position has values that are not finite",
        ),
    ],
)
def test_damaged_pieces_are_refused(change, message):
    simulation = SIMULATOR.create(
        foaming("splash"), device="cpu", folder=Path(), ranks=Ranks(RankInTurn(0, 1))
    )
    advance(simulation, 2)
    piece = dict(simulation.state())
    change(piece)
    with pytest.raises(ValueError, match=message):
        simulation.restore_pieces([piece])


def test_a_length_beyond_the_boxes_is_refused_with_the_longest():
    """Three ranks have boxes of at least 12 of 40 cells, 10 of them within reach."""

    def work(seat: RankInTurn) -> str:
        given = foaming("splash")
        far = given.model_copy(
            update={"whitewater": given.whitewater.model_copy(update={"length": 0.4})}
        )
        with pytest.raises(ValueError, match="beyond the boxes") as error:
            SIMULATOR.create(far, device="cpu", folder=Path(), ranks=Ranks(seat))
        return str(error.value)

    assert set(on_ranks(3, work)) == {
        "whitewater.length = 0.4 m reaches beyond the boxes of 3 ranks: at most 0.25 m, or start "
        "fewer ranks"
    }


def test_an_unbounded_domain_is_refused():
    """Ranks share a whole domain; no grid of theirs follows the liquid."""
    tables = {"domain": {"spacing": 0.025, "dimension": 2}, "liquid": SPLASH["liquid"]}
    unbounded = LiquidScene.model_validate(
        {"scene": {"simulator": "fluids"}, "time": {"duration": 1.0}, "whitewater": {}} | tables
    )

    def work(seat: RankInTurn) -> str:
        with pytest.raises(ValueError, match=r"domain\.spacing, an unbounded domain") as error:
            SIMULATOR.create(unbounded, device="cpu", folder=Path(), ranks=Ranks(seat))
        return str(error.value)

    assert all("give domain.size and domain.resolution" in words for words in on_ranks(2, work))


@pytest.mark.parametrize(("counts", "size"), [((24, 12, 1), 2), ((12, 12, 12), 8)])
def test_particles_go_to_the_rank_of_their_cell_once(counts, size):
    """From any rank to any other one, also across several boxes; the oldest are found exactly."""
    position, velocity = (values.astype(np.float32) for values in scattered(counts, 500))
    number = np.repeat(np.arange(500, dtype=np.float32)[:, None], 3, axis=1)

    def work(seat: RankInTurn):
        part = part_of(seat, counts)
        mine = slice(seat.rank, None, size)
        arrays = {"position": position, "velocity": velocity, "kept": number}
        found = part.send_to_owners({name: values[mine] for name, values in arrays.items()})
        assert (part.owners(cells_of(found["position"])) == seat.rank).all()
        rows = found["kept"][:, 0].astype(int)
        for name, values in arrays.items():
            np.testing.assert_array_equal(found[name], values[rows])
        assert part.send_to_owners(found) is None
        count = len(removed := oldest(found["kept"], found["position"], 37, part.ranks))
        assert (found["kept"][removed, 0] >= 463).all()
        return rows, count

    results = on_ranks(size, work)
    np.testing.assert_array_equal(
        np.sort(np.concatenate([rows for rows, _ in results])), np.arange(500)
    )
    assert sum(count for _, count in results) == 37
