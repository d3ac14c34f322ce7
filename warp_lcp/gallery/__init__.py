"""Test problems for methods, deterministic by seed; most with a known solution."""

from warp_lcp.gallery.contact_scenes import SCENES, contact, contact_scene
from warp_lcp.gallery.contact_stepper import ContactStepper
from warp_lcp.gallery.families import FAMILIES
from warp_lcp.gallery.fclib import FclibProblem, read_fclib
from warp_lcp.gallery.fluid import Splash, basin, splash
from warp_lcp.gallery.heston import Heston, OptionPrices
from warp_lcp.gallery.matrices import banded, definite, period_three, semidefinite, skewed
from warp_lcp.gallery.obstacle import ball_obstacle, dam, journal_bearing, sine_obstacle, torsion
from warp_lcp.gallery.planted import PlantedSolution, planted, poisson
from warp_lcp.gallery.published import PUBLISHED, PublishedFigure
from warp_lcp.gallery.rigid_world import World
from warp_lcp.gallery.shallow_ice import IceDome
from warp_lcp.host_problem import FACTS, Problem
from warp_lcp.rigid.contact_models import (
    BoxedModel,
    ContactSystem,
    FrozenBoxModel,
    StewartTrinkleModel,
    proximal_sweeps,
)
from warp_lcp.settings import renamed_names

__all__ = [
    "FACTS",
    "FAMILIES",
    "PUBLISHED",
    "SCENES",
    "BoxedModel",
    "ContactStepper",
    "ContactSystem",
    "FclibProblem",
    "FrozenBoxModel",
    "Heston",
    "IceDome",
    "OptionPrices",
    "PlantedSolution",
    "Problem",
    "PublishedFigure",
    "Splash",
    "StewartTrinkleModel",
    "World",
    "ball_obstacle",
    "banded",
    "basin",
    "contact",
    "contact_scene",
    "dam",
    "definite",
    "journal_bearing",
    "period_three",
    "planted",
    "poisson",
    "proximal_sweeps",
    "read_fclib",
    "semidefinite",
    "sine_obstacle",
    "skewed",
    "splash",
    "torsion",
]


__getattr__ = renamed_names(
    __name__, Plant="PlantedSolution", Prices="OptionPrices", Published="PublishedFigure"
)
