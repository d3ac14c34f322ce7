"""Granular materials: what a scene may call by name, and where the numbers come from.

The angles are between loose and dense packing as soil mechanics measures them, near the loose one, which is that of a heap: uniform sand
of round grains 27.5 to 34 degrees, sandy gravel 35 to 50 [Terzaghi & Peck 1967, table 17.1]; the densities are between both too, dry
uniform sand 1430 to 1750 kg/m^3 [table 6.3]. Sugar: angle
of repose and bulk density of dry granulated sugar [Beakawi Al-Hashemi & Al-Amoudi 2018, a review]. Friction against walls is that of
smooth solid walls, about two thirds of the angle's tangent. Every number may be set in a scene instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

AngleOf = Literal["repose", "plane-strain", "triaxial-compression"]


@dataclass(frozen=True, kw_only=True)
class Material:
    """A granular material.

    Attributes:
        friction_angle: at which it stops on a slope of itself [degrees].
        density: of the material at its densest [kg/m^3], air included.
        max_fraction: of space that grains fill at their densest.
        wall_friction: Coulomb's coefficient against solids.
    """

    friction_angle: float
    density: float
    max_fraction: float
    wall_friction: float


MATERIALS = {
    "dry-sand": Material(friction_angle=30.0, density=1600.0, max_fraction=0.60, wall_friction=0.4),
    "gravel": Material(friction_angle=40.0, density=1800.0, max_fraction=0.65, wall_friction=0.5),
    "sugar": Material(friction_angle=35.0, density=850.0, max_fraction=0.55, wall_friction=0.45),
}


def repose_slope(angle: float) -> float:
    """Return k of the yield set |s|_F / sqrt(2) <= k p whose layers stop at an angle [degrees], k = tan(angle).

    What slides along a slope shears alone, under equal normal stresses: its shear stress over its pressure is the slope's tangent. Sand
    that rests and has pushed against itself along the slope holds up to asin(k), 35.3 degrees where k = tan(30 degrees): heaps that are
    poured slowly lie between both.

    >>> round(repose_slope(26.565), 3)
    0.5
    """
    return math.tan(math.radians(angle))


def plane_strain_slope(angle: float) -> float:
    """Return k of the yield set that has a friction angle [degrees] in plane strain (Mohr and Coulomb's), k = sin(angle).

    In 3-D the same cone is flatter where a sample is compressed along one axis: 30 degrees become 22.2, see `compression_slope`.

    >>> round(plane_strain_slope(30.0), 3)
    0.5
    """
    return math.sin(math.radians(angle))


def compression_slope(angle: float) -> float:
    """Return k of the yield set that has a friction angle [degrees] in triaxial compression, k = 2 sqrt(3) sin / (3 - sin).

    Derived from |s|_F = sqrt(2/3) q and q = 6 sin / (3 - sin) p, where q is the difference of the principal stresses.

    >>> round(compression_slope(22.23), 3)
    0.5
    """
    sine = math.sin(math.radians(angle))
    return 2.0 * math.sqrt(3.0) * sine / (3.0 - sine)


def slope(angle: float, test: AngleOf, dimension: int) -> float:
    """Return k of an angle [degrees] by the test that it is of; in 2-D there is no other compression than plane strain's."""
    if test == "repose":
        return repose_slope(angle)
    return compression_slope(angle) if test == "triaxial-compression" and dimension == 3 else plane_strain_slope(angle)
