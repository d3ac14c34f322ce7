"""Named granular materials, with the sources of their parameters.

Friction angles lie between those of loose and dense packing in soil mechanics, near the loose one,
which is that of a heap: uniform sand of round grains 27.5 to 34 degrees, sandy gravel 35 to 50
[Terzaghi & Peck 1967, table 17.1]. Densities lie between both as well: dry uniform sand 1430 to
1750 kg/m^3 [table 6.3]. Sugar: angle of repose and bulk density of dry granulated sugar [Beakawi
Al-Hashemi & Al-Amoudi 2018, a review]. Friction against walls is that of smooth solid walls, about
two thirds of the angle's tangent. A scene can override every number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

FrictionAngleTest = Literal["repose", "simple-shear", "plane-strain", "triaxial-compression"]


@dataclass(frozen=True, kw_only=True)
class Material:
    """Granular material.

    Attributes:
        friction_angle: angle of repose, that of a heap [degrees].
        density: bulk density at the densest packing, with air [kg/m^3].
        max_fraction: volume fraction of grains at the densest packing.
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


def slope(angle: float, test: FrictionAngleTest, dimension: int) -> float:
    """Return k of the yield set |s|_F / sqrt(2) <= k p for a friction angle.

    The angle [degrees] is that of the given test.

    Simple shear: layers stop at this angle, k = tan. Material that slides along a slope is in
    simple shear, under equal normal stresses: its shear stress over its pressure is the slope's
    tangent. Sand at rest that was compressed along the slope stays up to asin(k), 35.3 degrees for
    k = tan(30 degrees).

    Repose: the angle of a heap that is poured slowly. It lies between both, atan(k) and asin(k), so
    that neither k = tan nor k = sin gives it. Their mean is taken, k = (sin + tan) / 2: for 30
    degrees layers stop at 28.3, and sand at rest stays up to 32.6.

    Plane strain: the criterion of Mohr and Coulomb, k = sin. In 3-D its cone has a smaller angle
    under compression along one axis: 30 degrees become 22.2. So triaxial compression has k = 2
    sqrt(3) sin / (3 - sin), from |s|_F = sqrt(2/3) q and q = 6 sin / (3 - sin) p, where q is the
    difference of the principal stresses. In 2-D the only compression is plane strain.

    >>> alike = ("repose", 27.97), ("simple-shear", 26.57), ("plane-strain", 30.0)
    >>> print(*(f"{slope(angle, test, 3):.3f}" for test, angle in alike))
    0.500 0.500 0.500
    >>> print(f"{slope(22.23, 'triaxial-compression', 3):.3f}")
    0.500
    """
    sine, tangent = math.sin(math.radians(angle)), math.tan(math.radians(angle))
    if test == "simple-shear":
        return tangent
    if test == "repose":
        return 0.5 * (sine + tangent)
    return (
        2.0 * math.sqrt(3.0) * sine / (3.0 - sine)
        if test == "triaxial-compression" and dimension == 3
        else sine
    )
