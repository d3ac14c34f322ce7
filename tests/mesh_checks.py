"""Independent checks of surfaces: closed, oriented, and enclosed volume."""

import numpy as np


def assert_closed(corners: np.ndarray) -> None:
    """Assert that triangles form a closed surface, or segments a closed outline.

    Every edge of a triangle belongs to exactly one other, which runs through it the other way.
    Every point of an outline has one segment that leaves it and one that arrives.
    """
    if corners.shape[1] == 2:
        for side in corners.T:
            assert len(np.unique(side)) == len(side)
        assert set(corners[:, 0]) == set(corners[:, 1])
        return
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    assert (edges[:, 0] != edges[:, 1]).all()
    forth, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    back = np.unique(edges[:, ::-1], axis=0)
    assert np.array_equal(forth, back)


def enclosed(points: np.ndarray, corners: np.ndarray) -> float:
    """Return the volume inside triangles, or the area inside an outline.

    The result follows from the divergence theorem. It is positive if they face outward.
    """
    x = points.astype(np.float64)[corners]
    if corners.shape[1] == 2:
        a, b = x[:, 0], x[:, 1]
        return float(0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    return float((x[:, 0] * np.cross(x[:, 1], x[:, 2])).sum() / 6.0)


def pieces(points: np.ndarray, corners: np.ndarray) -> int:
    """Return the number of separate surfaces."""
    label = np.arange(len(points))
    while True:
        before = label.copy()
        least = label[corners].min(axis=1)
        for side in corners.T:
            np.minimum.at(label, side, least)
        label = label[label]
        if np.array_equal(before, label):
            return len(np.unique(label[corners]))
