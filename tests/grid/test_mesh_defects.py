"""Defects of a mesh: each is repaired and reported with its place, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from test_triangle_mesh import CUBE, CUBE_TRIANGLES, distances, icosphere

from warp_lcp.grid.signed_distance import TriangleMesh
from warp_lcp.grid.triangle_mesh import ClosedSurface, builtin_mesh, close_surface, weld
from warp_lcp.grid.voxelize import repair_notes
from warp_lcp.rigid.mass_properties import mass_properties

CHANCE = np.random.default_rng(4420)
VERTICES, TRIANGLES = weld(*icosphere(2))
POINTS = CHANCE.uniform(-1.2, 1.2, (2000, 3))


def inside(surface: ClosedSurface) -> np.ndarray:
    return distances(TriangleMesh(surface=surface), POINTS) < 0.0


def flipped(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return VERTICES, np.concatenate([TRIANGLES[~some], TRIANGLES[some][:, ::-1]])


def repeated(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return VERTICES, np.concatenate([TRIANGLES, TRIANGLES[some][:, [1, 2, 0]]])


def repeated_and_flipped(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return VERTICES, np.concatenate([TRIANGLES[some][:, ::-1], TRIANGLES])


def on_two_sides(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return every triangle in both orientations, as some modelers export them."""
    return VERTICES, np.concatenate([TRIANGLES, TRIANGLES[:, ::-1]])


def inside_out(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return VERTICES, TRIANGLES[:, ::-1]


def degenerate(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return VERTICES, np.concatenate([TRIANGLES, TRIANGLES[some][:, [0, 0, 1]]])


@pytest.mark.parametrize("share", [0.01, 0.2])
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (flipped, "disagreed with their neighbors' orientation, the first at ["),
        (repeated, "repeated triangles, the first at ["),
        (repeated_and_flipped, "repeated triangles, the first at ["),
        (on_two_sides, "repeated triangles, the first at ["),
        (inside_out, "the mesh was inside out; turned"),
        (degenerate, "degenerate triangles (without area), the first at ["),
    ],
)
def test_repairable_defects_are_repaired_and_reported(spoil, words: str, share: float) -> None:
    some = CHANCE.random(len(TRIANGLES)) < share
    some[7] = True
    surface = close_surface(*spoil(some), "ball")
    assert len(surface.triangles) == len(TRIANGLES)
    assert np.array_equal(inside(surface), inside(close_surface(VERTICES, TRIANGLES, "ball")))
    assert any(warning.startswith("ball: ") and words in warning for warning in surface.warnings), (
        surface.warnings
    )
    assert surface.crossings.place is None


def two(shift: list[float], size: float = 1.0) -> ClosedSurface:
    vertices = np.concatenate([CUBE, size * CUBE + shift])
    return close_surface(vertices, np.concatenate([CUBE_TRIANGLES, 8 + CUBE_TRIANGLES]), "cubes")


@pytest.mark.parametrize(
    "shift", [[0.5, 0.5, 0.5], [0.3, 0.2, 0.1], [0.5, 0.0, 0.0], [0.9, 0.1, 0.1]]
)
def test_overlapping_parts_become_their_union_and_are_reported(shift: list[float]) -> None:
    surface = two(shift)
    overlap = np.prod(1.0 - np.array(shift))
    assert surface.crossings.count > 0 and surface.crossings.inverted == 0.0
    assert (
        (surface.crossings.place >= 0.0) & (surface.crossings.place <= 1.0 + np.array(shift))
    ).all()
    union = np.any(
        [
            ((corner < POINTS) & (corner + 1.0 > POINTS)).all(axis=1)
            for corner in (np.zeros(3), np.array(shift))
        ],
        axis=0,
    )
    assert np.array_equal(inside(surface), union)
    assert surface.volume == pytest.approx(2.0), "what is there twice counts twice"
    (note,) = repair_notes(TriangleMesh(surface=surface), "solid[0] (mesh)")
    assert (
        note.startswith("solid[0] (mesh): cubes: ") and "triangles cross others, first at [" in note
    )
    if overlap > 0.05:
        with pytest.raises(
            ValueError,
            match=r"cubes: about \d+% of its surface lies inside itself and would count twice",
        ):
            mass_properties(TriangleMesh(surface=surface), 3, density=1.0)


@pytest.mark.parametrize(
    ("shift", "size"),
    [
        ([1.0, 0.0, 0.0], 1.0),
        ([1.0, 1.0, 0.0], 1.0),
        ([1.0, -0.5, -0.5], 2.0),
        ([1.0, 0.3, 0.2], 0.5),
    ],
)
def test_parts_that_touch_are_no_crossing(shift: list[float], size: float) -> None:
    assert two(shift, size).crossings.place is None


def test_a_part_inside_another_is_reported() -> None:
    surface = two([0.25, 0.25, 0.25], 0.5)
    assert surface.crossings.count == 0 and surface.crossings.doubled == pytest.approx(
        0.2, abs=0.02
    )
    (note,) = repair_notes(TriangleMesh(surface=surface), "x")
    assert "a part lies inside another, at [" in note


def test_a_part_that_is_turned_out_of_itself_is_refused() -> None:
    """Refusal of an inverted part.

    One half of a figure of eight has a winding number of -1 and would be missing.
    """
    vertices = VERTICES.copy()
    vertices[:, 0] *= vertices[:, 2] + 0.3
    surface = close_surface(vertices, TRIANGLES, "eight")
    assert surface.crossings.inverted > 0.2
    with pytest.raises(
        ValueError,
        match=r"solid: eight: \d+ of its 320 triangles cross others, first at .* is inside out "
        r"there",
    ):
        repair_notes(TriangleMesh(surface=surface), "solid")


def test_a_dent_is_accepted_and_one_through_the_other_side_is_reported() -> None:
    for depth, crosses in ((0.5, False), (-1.5, True)):
        vertices = VERTICES.copy()
        vertices[5] *= depth
        assert (close_surface(vertices, TRIANGLES, "ball").crossings.count > 0) == crosses


@pytest.mark.parametrize(
    "surface",
    [builtin_mesh("torus"), builtin_mesh("knot"), close_surface(*icosphere(4), "ball")],
    ids=lambda s: s.name,
)
def test_whole_meshes_have_no_crossing(surface: ClosedSurface) -> None:
    assert surface.crossings.place is None
