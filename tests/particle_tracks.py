"""Check that ids follow particles from step to step."""

import numpy as np

from warp_lcp.simulation import Points


class TrackCheck:
    """Checks of the ids in consecutive frames.

    Args:
        size: sides of the domain [m].
        spacing: of the cells [m].
        endless: periodic axes.

    Attributes:
        born: ids seen so far, by the largest one.
        longest: largest displacement of a particle in a step, in cells.
        gone: number of particles that have been removed.
    """

    def __init__(self, size: list[float], spacing: float, endless: tuple[int, ...] = ()) -> None:
        self.size, self.spacing, self.endless = [*size, spacing][:3], spacing, endless
        self.born, self.longest, self.gone = -1, 0.0, 0
        self._ids, self._points = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        self._ages = np.zeros(0)

    def add(self, points: Points, dt: float, most: float) -> None:
        """Compare a frame with the last one.

        Ids are unique and were given in order. Particles in both frames have moved by at most
        `most` cells and are older by dt; the others are new, and ids of removed particles do not
        come back.

        Args:
            points: particles after a step.
            dt: length of the step [s].
            most: largest displacement [cells].
        """
        ids, ages = points.fields["id"], points.fields["age"].astype(float)
        order = np.argsort(ids)
        ids, ages, where = ids[order], ages[order], points.points[order].astype(float)
        assert (np.diff(ids) > 0).all(), "an id occurs twice"
        assert len(ids) == 0 or ids[0] >= 0, "a particle has no id"
        known = np.isin(ids, self._ids, assume_unique=True)
        assert (ids[~known] > self.born).all(), "a removed particle's id was given again"
        assert (ages[~known] <= dt * (1.0 + 1e-5) + 1e-6).all(), "a new particle is old"
        before = np.searchsorted(self._ids, ids[known])
        way = where[known] - self._points[before]
        for axis in self.endless:
            way[:, axis] -= self.size[axis] * np.round(way[:, axis] / self.size[axis])
        cells = np.linalg.norm(way, axis=1).max(initial=0.0) / self.spacing
        assert cells <= most, f"an id has jumped by {cells:.2f} cells"
        np.testing.assert_allclose(ages[known] - self._ages[before], dt, atol=1e-5)
        self.longest = max(self.longest, cells)
        self.gone += len(self._ids) - int(known.sum())
        self.born = max(self.born, int(ids.max(initial=-1)))
        self._ids, self._points, self._ages = ids, where, ages
