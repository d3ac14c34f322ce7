"""Suspicious settings: wrong units, gravity upward, material beyond the domain.

They are allowed. A run and `check` report them at the start, with the value, the usual range, and
the unit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_lcp.scene.scene import Scene
    from warp_lcp.scene.shapes import MaterialProperties, Solid

FRACTION = 0.25 * math.pi  # angles in radians are often multiples of this
DIGITS = 1e-3  # relative accuracy of that test
STRONG = 50.0  # gravity [m/s^2]: twice that of Jupiter
# Speed [m/s] of sound in air, beyond which no liquid or sand is incompressible for long.
FAST = 340.0
MOVED = 0.5  # cells: a shorter motion by the end of a run is not visible


@dataclass(frozen=True)
class UsualRange:
    """Usual range of a key.

    Args:
        low: least value without a warning.
        high: greatest value without a warning.
        unit: unit of the key; "" for numbers without one.
        known: the usual range in words.
        other: another unit in which the number may have been given.
        factor: one of the other unit in the key's unit.
    """

    low: float
    high: float
    unit: str
    known: str
    other: str = ""
    factor: float = 1.0

    def notes(self, place: str, value: float | None) -> Iterator[str]:
        """Yield a line about a value outside the range."""
        if value is None or self.low <= value <= self.high:
            return
        meant = f"; if {self.other} was meant, it is {value * self.factor:g}" if self.other else ""
        yield f"{place} = {value:g}{self.unit and ' '}{self.unit}: {self.known} are usual{meant}"


LIQUID_DENSITY = UsualRange(
    300.0, 25e3, "kg/m^3", "600 to 14,000 for liquids, water has 1000,", "g/cm^3", 1e3
)
GRAIN_DENSITY = UsualRange(
    100.0, 10e3, "kg/m^3", "1,200 to 2,000 for sand, air included,", "g/cm^3", 1e3
)
BODY_DENSITY = UsualRange(5.0, 25e3, "kg/m^3", "10 (foam) to 22,600 (osmium)", "g/cm^3", 1e3)


def radians_meant(
    place: str, values: float | Sequence[float] | None, unit: str = "degrees"
) -> Iterator[str]:
    """Yield a line about angles that look like radians.

    A multiple of pi / 4 to three digits, with two decimals or more.
    """
    for value in np.atleast_1d([] if values is None else values).tolist():
        multiple = round(value / FRACTION)
        near = abs(value - FRACTION * multiple) < DIGITS * abs(value) and round(value, 1) != value
        if 0 < abs(multiple) <= 8 and near:
            yield (
                f"{place} = {value:g} is in {unit}; if radians were meant, it is {45 * multiple:g}"
            )


def scene_notes(scene: Scene) -> Iterator[str]:
    """Yield suspicious settings in the tables of every scene."""
    gravity, time = scene.physics.gravity, scene.time
    strength = math.hypot(*gravity)
    if gravity[1] > 0.0:
        yield (
            f"physics.gravity = {gravity} points up: y is up, so gravity is usually [0, -9.81] "
            "m/s^2"
        )
    if strength > STRONG:
        yield (
            f"physics.gravity = {gravity} is in m/s^2 (Earth: 9.81); if cm/s^2 were meant, it is "
            f"{0.01 * strength:g}"
        )
    for axis, given, side in scene.domain.rounded_sides:
        yield (
            f"domain.size[{axis}] = {given:.8g} is rounded up to {side:.8g}, "
            f"{scene.cell_counts[axis]} cells of {scene.spacing:.6g} m"
        )
    if time.duration * time.frames_per_second < 1.0 - 1e-9:
        yield (
            f"time.duration = {time.duration:g} s is shorter than a frame, "
            f"{1.0 / time.frames_per_second:g} s at time.frames_per_second ="
            f" {time.frames_per_second:g}: only the first and the last frame are written"
        )
    yield from _output_notes(scene)
    for number, solid in enumerate(scene.solid):
        yield from _solid_notes(scene, f"solid[{number}]", solid)
    for place, shape in scene.shapes():
        yield from radians_meant(f"{place}.rotate", shape.rotate)
        velocity = getattr(shape, "velocity", None)
        if velocity is not None and math.hypot(*velocity) > FAST:
            yield (
                f"{place}.velocity = {velocity} is in m/s (sound in air: 340); if mm/s were "
                "meant, divide by 1000"
            )


def _output_notes(scene: Scene) -> Iterator[str]:
    """Yield keys of [output] that have no effect, because what they change is not written."""
    output, has_bodies = scene.output, any(solid.is_body for solid in scene.solid)
    unused = {
        'volume_format = "vdb"': (output.volume_format == "vdb", output.volume, "volume"),
        'grid_format = "vti"': (output.grid_format == "vti", output.grid, "grid"),
        # Rigid bodies are surfaces, too.
        "surface_ply = true": (output.surface_ply, output.surface or has_bodies, "surface"),
        "ids = true": (output.ids, output.particles, "particles"),
    }
    for setting, (chosen, written, part) in unused.items():
        if chosen and not written:
            yield f"output.{setting} has no effect without output.{part} = true"


def _solid_notes(scene: Scene, place: str, solid: Solid) -> Iterator[str]:
    """Yield suspicious settings of a solid's motion, mass or density."""
    for key in ("phase", "angle"):
        yield from radians_meant(f"{place}.motion.{key}", getattr(solid.motion, key, None))
    yield from radians_meant(
        f"{place}.motion.rate", getattr(solid.motion, "rate", None), "degrees/s"
    )
    yield from radians_meant(f"{place}.angular_velocity", solid.angular_velocity, "degrees/s")
    yield from BODY_DENSITY.notes(f"{place}.density", solid.density)
    if solid.mass is not None:
        volume, unit = scene.enclosed_volume(solid), "kg" if scene.dimension == 3 else "kg/m"
        # The box around the shape is larger than the shape.
        least = solid.mass / volume if volume > 0.0 else 0.0
        if least > BODY_DENSITY.high:
            yield (
                f"{place}.mass = {solid.mass:g} is in {unit}: the body has {least:,.0f} kg/m^3 or "
                f"more, {BODY_DENSITY.known} are usual; "
                f"if grams were meant, it is {1e-3 * solid.mass:g}"
            )


def material_notes(
    scene: Scene, key: str, materials: Sequence[MaterialProperties]
) -> Iterator[str]:
    """Yield warnings about material outside the domain, and scenes without motion."""
    size = np.array(scene.domain.size)
    for number, shape in enumerate(materials):
        box = None if shape.invert else shape.bounds(scene.dimension)
        if box is None:
            continue
        low, high = (corner[: scene.dimension] for corner in box)
        beyond, middle = float(np.maximum(-low, high - size).max()), 0.5 * (low + high)
        # A drop may be centered on a wall, which cuts it in half.
        outside = bool(((middle < 0.0) | (middle > size)).any())
        if beyond > scene.spacing and (outside or (shape.shape == "box" and shape.rotate is None)):
            yield (
                f"{key}[{number}] ({shape.shape}) extends {beyond:.4g} m beyond the domain, which "
                "extends from the origin to "
                f"{scene.domain.size} m: the part outside is left out"
            )
    velocities = [getattr(shape, "velocity", None) or [0.0] for _, shape in scene.shapes()]
    fastest = max((math.hypot(*velocity) for velocity in velocities), default=0.0)
    shortest = scene.time.cfl * scene.spacing / fastest if fastest > 0.0 else math.inf
    if scene.time.dt_min > shortest:
        yield (
            f"time.dt_min = {scene.time.dt_min:g} s is longer than the stable step, {shortest:.3g} "
            f"s for time.cfl = {scene.time.cfl:g} "
            f"at {fastest:g} m/s: steps may be unstable"
        )
    if any(solid.motion is not None for solid in scene.solid):
        return
    end, gravity = scene.time.duration, math.hypot(*scene.physics.gravity)
    moved = end * (fastest + 0.5 * gravity * end)
    if 0.0 < moved < MOVED * scene.spacing:
        yield (
            f"time.duration = {end:g} s: nothing moves by more than {moved:.3g} m until then, "
            f"{moved / scene.spacing:.2g} of a cell; "
            "lengths are in m, times in s"
        )
