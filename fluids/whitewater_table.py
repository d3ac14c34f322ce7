"""Scene table of whitewater."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from warp_lcp.scene.scene import Table
from warp_lcp.settings import Count, CountOrZero, NonNegative, Positive

SHARE = 16  # default length: this part of the domain's longest side
CELLS = 4  # default length in an unbounded domain [cells]
GRAVITY = 9.81  # for default speeds without gravity [m/s^2]
# Default ranges of speeds, in units of sqrt(g length), so that scenes of all sizes look alike. The
# approach of liquid rises from 0: where two streams meet, coarse cells spread a change of velocity
# over a longer way, which leaves the integral of the approach the same, but not that of its excess
# over a threshold.
SPEEDS = {"trapped_air": (0.0, 1.5), "speed": (1.0, 3.0)}
# Default rates by dimension d: particles per length^d of liquid and second, and per length^(d - 1)
# of crests.
TRAPPED_AIR_RATE, CREST_RATE = {2: 4e3, 3: 1.2e4}, {2: 1e3, 3: 6e3}

# Mean of Phi_k Phi_ta over the liquid and a run, crests counted as trapped air: 0.7 and 1.2 % in
# the 3-D scenes of `benchmarks.whitewater`, 1.4 and 1.6 % in its 2-D ones.
MEAN_POTENTIAL = 0.01


def _is_range(limits: list[float]) -> list[float]:
    """Return the limits of a potential, the lower one first."""
    if not 0.0 <= limits[0] < limits[1]:
        raise PydanticCustomError("range", "must be [least, most] with 0 <= least < most")
    return limits


Range = Annotated[list[float], Field(min_length=2, max_length=2), AfterValidator(_is_range)]


class WhitewaterSettings(Table):
    """[whitewater]: spray, foam and bubbles; off without the table.

    New particles are proportional to a potential of the kinetic energy, times one of trapped air
    or of wave crests [Ihmsen et al. 2012]. Each potential rises from 0 at the first number of its
    range to 1 at the second one.
    """

    length: Positive | None = Field(
        default=None,
        description="distance over which velocities and the surface are compared [m]; default: "
        "1/16 of the domain's longest side, 4 cells with spacing",
    )
    speed: Range | None = Field(
        default=None,
        description="speeds between which the potential of the kinetic energy rises [m/s]; "
        "default: 1 and 3 sqrt(g length)",
    )
    trapped_air: Range | None = Field(
        default=None,
        description="approach of liquid over length, between which the potential rises [m/s]; "
        "default: 0 and 1.5 sqrt(g length)",
    )
    crest: Range = Field(
        default=[0.2, 1.0],
        description="length over radius of curvature of a crest, between which the potential rises",
    )
    trapped_air_rate: NonNegative | None = Field(
        default=None,
        description="new particles per volume of liquid and second [1/(m^3 s); 1/(m^2 s) in 2-D]; "
        "default: 12,000 / length^3, 2-D: 4000 / length^2",
    )
    crest_rate: NonNegative | None = Field(
        default=None,
        description="new particles per area of crests and second [1/(m^2 s); 1/(m s) in 2-D]; "
        "default: 6000 / length^2, 2-D: 1000 / length",
    )
    lifetime: Positive = Field(default=2.0, description="mean life of a particle as foam [s]")
    buoyancy: NonNegative = Field(
        default=2.0, description="acceleration of a bubble at rest, in units of gravity"
    )
    rise_speed: Positive = Field(
        default=0.25, description="speed of a bubble in liquid at rest [m/s]"
    )
    air_drag: NonNegative = Field(
        default=0.2, description="rate at which air slows down spray [1/s]"
    )
    max_particles: Count = Field(
        default=1_000_000, description="largest number of particles; the oldest go if more arise"
    )
    seed: CountOrZero = Field(default=2012, le=2**31 - 1, description="seed of the random numbers")

    def resolved(
        self, *, longest: float | None, spacing: float, gravity: Sequence[float], dimension: int
    ) -> WhitewaterSettings:
        """Return the settings with values in place of the defaults that depend on the scene.

        Args:
            longest: longest side of the domain [m]; None if it is unbounded.
            spacing: of the cells [m].
            gravity: [m/s^2].
            dimension: 2 or 3.
        """
        length = self.length or (CELLS * spacing if longest is None else longest / SHARE)
        unit = math.sqrt((math.hypot(*gravity) or GRAVITY) * length)
        low = {name: [part * unit for part in share] for name, share in SPEEDS.items()}
        trapped, crest = self.trapped_air_rate, self.crest_rate
        values = {
            "length": length,
            "speed": self.speed or low["speed"],
            "trapped_air": self.trapped_air or low["trapped_air"],
            "trapped_air_rate": TRAPPED_AIR_RATE[dimension] / length**dimension
            if trapped is None
            else trapped,
            "crest_rate": CREST_RATE[dimension] / length ** (dimension - 1)
            if crest is None
            else crest,
        }
        return self.model_copy(update=values)

    def expected_count(self, volume: float, duration: float) -> int:
        """Return the estimated mean number of particles in a run; at most `max_particles`.

        If N' particles arise per second and live for T seconds, there are N' min(t, T) after t. The
        mean over the duration D is N' m (1 - m / (2 D)) with m = min(T, D).

        Args:
            volume: of the liquid [m^3; m^2 in 2-D].
            duration: of the run [s].
        """
        assert self.trapped_air_rate is not None, "the settings are resolved"
        lives = min(self.lifetime, duration)
        mean = self.trapped_air_rate * volume * lives * (1.0 - 0.5 * lives / duration)
        return round(min(MEAN_POTENTIAL * mean, self.max_particles))
