"""Content of images of a run: parts of the material, and the quantity of the particles' colors."""

from __future__ import annotations

from enum import StrEnum

from warp_lcp.simulation import InputError


class RenderError(InputError):
    """An image cannot be drawn.

    The message says why and what to do.
    """


class Color(StrEnum):
    """Quantity of the particles' colors."""

    SPEED = "speed"
    PRESSURE = "pressure"
    FRACTION = "fraction"
    YIELD_RATIO = "yield_ratio"
    PLAIN = "plain"


class VisiblePart(StrEnum):
    """Part of the material in images."""

    PARTICLES = "particles"
    SURFACE = "surface"
    BOTH = "both"
    BODIES = "bodies"  # no material


WITH_PARTICLES, WITH_SURFACE = (
    (VisiblePart.PARTICLES, VisiblePart.BOTH),
    (VisiblePart.SURFACE, VisiblePart.BOTH),
)


# Parts that frames must have.
PARTS = {
    VisiblePart.PARTICLES: "particles",
    VisiblePart.SURFACE: "surface",
    VisiblePart.BODIES: "bodies",
}
# Further quantities of sand's particles.
LABELS = {Color.FRACTION: "fraction of grains", Color.YIELD_RATIO: "yield ratio"}
