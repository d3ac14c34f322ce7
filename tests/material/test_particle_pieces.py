"""States of particles in parts and as a whole."""

import numpy as np
import pytest

from small_liquids import advance, dam
from warp_lcp.material.particle_pieces import fields_of, piece_of, state_of


def cut(piece, at):
    """Return a part split into two at a plane of cells across x."""
    spacing = piece["signature"][4]
    left = piece["position"][:, 0] < at * spacing
    parts = []
    for inside, low, high in ((left, 0, at), (~left, at, piece["counts"][0])):
        box = piece["box"].copy()
        box[:, 0] = low, high
        particles = {
            name: values[inside]
            for name, values in piece.items()
            if len(values.shape) and len(values) == len(left)
        }
        parts.append(
            {
                **piece,
                **particles,
                **{name: field[..., low:high] for name, field in fields_of(piece).items()},
                "box": box,
            }
        )
    return parts


@pytest.mark.parametrize("dimension", [2, 3])
def test_checkpoint_parts_restore_their_state(dimension):
    simulation = dam(dimension)
    advance(simulation, 0.06)
    state = simulation.state()
    pieces = cut(piece_of(state), 5)
    assert min(len(piece["position"]) for piece in pieces) > 10
    for parts in (pieces, pieces[::-1], [piece_of(state)]):
        restored = dam(dimension)
        found = state_of(parts, restored.state())
        assert found.keys() == state.keys()
        for name, values in state.items():
            np.testing.assert_array_equal(found[name], values, err_msg=name)
            assert found[name].dtype == values.dtype
        restored.restore_pieces(parts)
        assert advance(restored, 0.08) == advance_copy(dimension, state)


def advance_copy(dimension, state):
    simulation = dam(dimension)
    simulation.restore(state)
    return advance(simulation, 0.08)


def test_incomplete_checkpoint_parts_are_named():
    simulation = dam(2)
    state = simulation.state()
    pieces = cut(piece_of(state), 5)
    with pytest.raises(ValueError, match="do not cover the domain"):
        state_of(pieces[:1], state)
    with pytest.raises(ValueError, match="the pieces lack velocity"):
        state_of(
            [{name: values for name, values in pieces[0].items() if name != "velocity"}, pieces[1]],
            state,
        )
    with pytest.raises(ValueError, match="the pieces lack everything"):
        state_of([], state)
    with pytest.raises(ValueError, match="the state lacks cells, position, signature"):
        piece_of({"time": np.array(0.0)})
