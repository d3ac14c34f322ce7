"""Scenes of rigid bodies alone: walls, solids that stand or are moved, and bodies that gravity and contacts move."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from warp_lcp.contacts.methods import BOXED, DEFAULT, STEWART_TRINKLE
from warp_lcp.problem.solve import PrecisionName
from warp_lcp.scene.presets import PresetName
from warp_lcp.scene.scene import MOST_CELLS, Domain, Output, Scene
from warp_lcp.scene.table import Complaint, Table
from warp_lcp.settings import Count, Share

NO_MATERIAL = "there is no material: bodies are all that moves"


class ContactDomain(Domain):
    """[domain]: the box; there is no grid."""

    resolution: int = Field(default=64, ge=2, le=MOST_CELLS, description="resolution of pictures")


class ContactSolver(Table):
    """[solver]: solution for the contact impulses."""

    preset: PresetName | None = Field(default=None, description="not for bodies alone")
    method: Literal[DEFAULT, *BOXED, *STEWART_TRINKLE] = Field(
        default=DEFAULT,
        description="sweeps-and-newton: as for bodies in liquids; from lemke on: friction model of Stewart and Trinkle; others: boxes",
    )
    directions: int = Field(
        default=4, ge=2, le=64, multiple_of=2, description="sides of the friction cone of Stewart and Trinkle in 3-D, even"
    )
    tolerance: Share = Field(default=1e-5, description="residual, relative to that of no impulses")
    max_iterations: Count = Field(default=600, description="iterations before a step accepts the impulses as they are")
    precision: PrecisionName = Field(default="double", description="double only")


class ContactOutput(Output):
    """[output]: files besides the surfaces of the bodies."""

    particles: bool = Field(default=False, description="not for bodies alone")
    grid: bool = Field(default=False, description="not for bodies alone")


class ContactScene(Scene):
    """A scene of rigid bodies without a material."""

    elsewhere: ClassVar = dict.fromkeys(("sand", "material", "friction"), "granular") | dict.fromkeys(("liquid", "particles"), "fluids")
    domain: ContactDomain
    solver: ContactSolver = Field(default_factory=ContactSolver)  # type: ignore[assignment]
    output: ContactOutput = Field(default_factory=ContactOutput)

    def complaints(self) -> list[Complaint]:
        """Return what is wrong across keys."""
        found = super().complaints()
        if not any(solid.is_body for solid in self.solid):
            found.append(Complaint(("solid",), None, "has no rigid body: give one a density or a mass"))
        for key in ("particles", "grid", "surface", "volume", "forces"):
            if getattr(self.output, key):
                found.append(Complaint(("output", key), True, f"must be false: {NO_MATERIAL}"))
        if self.physics.density != type(self.physics).model_fields["density"].default:
            found.append(Complaint(("physics", "density"), self.physics.density, f"{NO_MATERIAL}; density is a key of each [[solid]]"))
        for key, usual in (("wall", "separating"), ("solids", "cut-cell"), ("follow", True)):
            if getattr(self.domain, key) != usual:
                found.append(Complaint(("domain", key), getattr(self.domain, key), f"has no meaning here: {NO_MATERIAL}"))
        if self.solver.preset is not None:
            found.append(Complaint(("solver", "preset"), self.solver.preset, "not for bodies alone: give time.dt_max and solver.tolerance"))
        if self.solver.precision != "double":
            found.append(Complaint(("solver", "precision"), self.solver.precision, "must be double"))
        if self.solver.directions != 4 and self.solver.method not in STEWART_TRINKLE:
            message = f"is of the methods {', '.join(STEWART_TRINKLE)}; {self.solver.method} takes friction in boxes"
            found.append(Complaint(("solver", "directions"), self.solver.directions, message))
        return found

    def plan(self) -> list[tuple[str, str]]:
        """Return what a run would do."""
        kept = {"preset", "open", "moving", "bodies", "time", "frames"}
        solver, moving = self.solver, sum(solid.is_body for solid in self.solid)
        model = f"Stewart and Trinkle, {solver.directions} sides" if solver.method in STEWART_TRINKLE else "boxes"
        return [
            *((word, line) for word, line in super().plan() if word in kept and (word != "bodies" or moving <= 8)),
            *([("bodies", f"{moving} of {len(self.solid)} solids")] if moving > 8 else []),
            ("solver", f"{solver.method} to {solver.tolerance:g}, at most {solver.max_iterations} iterations; friction: {model}"),
        ]

    def _grid_complaints(self) -> list[Complaint]:
        """Return what is wrong with the domain; its sides need not be whole numbers of cells."""
        found = self.domain.spacing_complaints()
        if self.domain.periodic is not None and len(self.domain.periodic) != self.dimension:
            found.append(Complaint(("domain", "periodic"), self.domain.periodic, f"must have {self.dimension} entries"))
        return found
