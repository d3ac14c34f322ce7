"""Problems to try methods on, each deterministic by its seed; most with a known solution."""

from warp_lcp.gallery.banded import banded
from warp_lcp.gallery.contact import contact
from warp_lcp.gallery.families import FAMILIES
from warp_lcp.gallery.fluid import Splash, basin, splash
from warp_lcp.gallery.obstacle import ball_obstacle
from warp_lcp.gallery.planted import Plant, planted, poisson
from warp_lcp.gallery.problem import FACTS, Problem
from warp_lcp.gallery.psd import definite, period_three, semidefinite, skewed

__all__ = [
    "FACTS",
    "FAMILIES",
    "Plant",
    "Problem",
    "Splash",
    "ball_obstacle",
    "banded",
    "basin",
    "contact",
    "definite",
    "period_three",
    "planted",
    "poisson",
    "semidefinite",
    "skewed",
    "splash",
]
