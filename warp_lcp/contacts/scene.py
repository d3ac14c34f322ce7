"""Scene tables of rigid bodies without a material: walls, solids, joints, targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from warp_lcp.contacts.kinematics import TargetPath, tree_of
from warp_lcp.contacts.methods import BOXED, CONE, DEFAULT, JOINTED, KINEMATIC, STEWART_TRINKLE
from warp_lcp.problem.method_protocol import PrecisionName
from warp_lcp.rigid.joints import WORLD, Joint, JointKind
from warp_lcp.scene.presets import PresetName
from warp_lcp.scene.scene import MOST_CELLS, Domain, Output, Scene
from warp_lcp.scene.shapes import SolidProperties
from warp_lcp.scene.table import CrossKeyError, Table, Vector, counted
from warp_lcp.settings import Count, Positive, Share

NO_MATERIAL = "there is no material, only bodies move"


class ContactDomain(Domain):
    """[domain]: the box; there is no grid."""

    has_grid: ClassVar = False

    resolution: int = Field(default=64, ge=2, le=MOST_CELLS, description="resolution of pictures")


class ContactSolver(Table):
    """[solver]: solution for the contact impulses."""

    preset: PresetName | None = Field(default=None, description="unused with bodies alone")
    method: Literal[DEFAULT, *BOXED, *STEWART_TRINKLE, *CONE] = Field(
        default=DEFAULT,
        description="sweeps-and-newton: as for bodies in liquids; lemke and after: friction model "
        "of Stewart and Trinkle; "
        "proximal-gauss-seidel: circular cone; others: boxed friction; default with joints: "
        f"{JOINTED}",
    )
    directions: int = Field(
        default=4,
        ge=2,
        le=64,
        multiple_of=2,
        description="sides of the friction cone of Stewart and Trinkle in 3-D, even",
    )
    tolerance: Share = Field(default=1e-5, description="residual, relative to that of no impulses")
    max_iterations: Count = Field(
        default=600, description="after these the step accepts the impulses"
    )
    precision: PrecisionName = Field(default="double", description="double only")


class ContactOutput(Output):
    """[output]: files besides the surfaces of the bodies."""

    particles: bool = Field(default=False, description="unused with bodies alone")
    grid: bool = Field(default=False, description="unused with bodies alone")


class JointTable(Table):
    """[[joint]]: connects two bodies at a point, or a body with space.

    Bodies of a joint do not collide.
    """

    kind: JointKind = Field(
        description="ball: turns about the anchor; hinge: about an axis; fixed: not"
    )
    solids: list[int] = Field(
        min_length=1,
        max_length=2,
        description="numbers of [[solid]] tables from 0: a rigid body, and a body or fixed solid; "
        "one number: joint to space",
    )
    anchor: Vector = Field(description="anchor in the initial pose [m]")
    axis: Vector | None = Field(default=None, description="axis of a hinge in 3-D; z in 2-D")
    limits: list[float] | None = Field(
        default=None,
        min_length=2,
        max_length=2,
        description="least and largest angle of a hinge [degrees], initially 0",
    )
    motor_speed: float | None = Field(
        default=None, description="target speed of the motor of a hinge [degrees/s]"
    )
    motor_torque: Positive | None = Field(
        default=None, description="largest torque of the motor [N m]"
    )

    def find_errors(self, dimension: int, solids: Sequence[SolidProperties]) -> list[CrossKeyError]:
        """Return errors of the joint among these solids in 2 or 3 dimensions."""
        errors, hinge = [], self.kind == "hinge"
        for number in self.solids:
            if not 0 <= number < len(solids):
                errors.append(
                    CrossKeyError(
                        ("solids",),
                        self.solids,
                        f"must be numbers of [[solid]]s, from 0 to {len(solids) - 1}",
                    )
                )
            elif solids[number].motion is not None:
                errors.append(
                    CrossKeyError(
                        ("solids",),
                        self.solids,
                        f"solid[{number}] has a motion: bodies can be joined only to a fixed solid",
                    )
                )
        if not errors and not solids[self.solids[0]].is_body:
            errors.append(
                CrossKeyError(
                    ("solids",),
                    self.solids,
                    "the first must be a rigid body: give it a density or a mass",
                )
            )
        if len(set(self.solids)) < len(self.solids):
            errors.append(CrossKeyError(("solids",), self.solids, "must differ"))
        for key in ("anchor", "axis"):
            value = getattr(self, key)
            if value is not None and len(value) != dimension:
                errors.append(
                    CrossKeyError((key,), value, f"must {counted(dimension)} in {dimension}-D")
                )
        for key in ("axis", "limits", "motor_speed", "motor_torque"):
            if not hinge and getattr(self, key) is not None:
                errors.append(
                    CrossKeyError(
                        (key,), getattr(self, key), f"is only for hinges: this joint is {self.kind}"
                    )
                )
        if (self.motor_speed is None) != (self.motor_torque is None):
            errors.append(
                CrossKeyError(
                    ("motor_torque",), self.motor_torque, "must be given together with motor_speed"
                )
            )
        if hinge and dimension == 3 and (self.axis is None or not any(self.axis)):
            errors.append(
                CrossKeyError(
                    ("axis",), self.axis, "must be given for a hinge in 3-D, and not be zero"
                )
            )
        if hinge and dimension == 2 and self.axis is not None:
            errors.append(
                CrossKeyError(("axis",), self.axis, "must be left out in 2-D, where it is z")
            )
        if self.kind == "ball" and dimension == 2:
            errors.append(CrossKeyError(("kind",), self.kind, "must be hinge in 2-D"))
        if self.limits is not None and not -180.0 <= self.limits[0] <= self.limits[1] <= 180.0:
            errors.append(
                CrossKeyError(("limits",), self.limits, "must be in order and within 180 degrees")
            )
        return errors

    def to_joint(self, bodies: Sequence[int]) -> Joint:
        """Return the joint.

        `bodies` maps each solid to its number among the bodies, or to WORLD for a solid that is no
        body.
        """
        first, second = [
            bodies[number] for number in [*self.solids, *([-1] if len(self.solids) == 1 else [])]
        ]
        anchor, axis = (
            np.array([*vector, 0.0][:3]) for vector in (self.anchor, self.axis or [0.0, 0.0, 1.0])
        )
        limits = np.radians([-np.inf, np.inf] if self.limits is None else self.limits).tolist()
        speed, torque = float(np.radians(self.motor_speed or 0.0)), self.motor_torque or 0.0
        return Joint(first, second, anchor, axis, (limits[0], limits[1]), speed, torque, self.kind)


class TargetTable(Table):
    """[[target]]: path of a point of a body, for inverse kinematics.

    Inverse kinematics moves the bodies, without forces and contacts. Each body must be the first
    body of a hinge; hinges form trees.
    """

    solid: int = Field(ge=0, description="number of the body among the [[solid]] tables, from 0")
    point: Vector = Field(description="point of the body, initial pose [m]")
    times: list[float] = Field(min_length=1, description="increasing [s]")
    places: list[Vector] = Field(
        min_length=1, description="its places at these times [m], straight lines between"
    )

    def find_errors(self, dimension: int, solids: Sequence[SolidProperties]) -> list[CrossKeyError]:
        """Return errors of the target among these solids in 2 or 3 dimensions."""
        errors = []
        if self.solid >= len(solids) or not solids[self.solid].is_body:
            errors.append(
                CrossKeyError(("solid",), self.solid, "must be the number of a rigid body")
            )
        for place, value in [
            (("point",), self.point),
            *((("places", index), row) for index, row in enumerate(self.places)),
        ]:
            if len(value) != dimension:
                errors.append(
                    CrossKeyError(place, value, f"must {counted(dimension)} in {dimension}-D")
                )
        if not (np.diff(self.times) > 0.0).all():
            errors.append(CrossKeyError(("times",), self.times, "must increase"))
        if len(self.places) != len(self.times):
            errors.append(
                CrossKeyError(
                    ("places",),
                    self.places,
                    f"must have {len(self.times)} entries, one for each time",
                )
            )
        return errors


class ContactScene(Scene):
    """Scene of rigid bodies without a material."""

    elsewhere: ClassVar = dict.fromkeys(
        ("sand", "material", "friction"), "granular"
    ) | dict.fromkeys(("liquid", "particles"), "fluids")
    domain: ContactDomain
    solver: ContactSolver = Field(default_factory=ContactSolver)  # type: ignore[assignment]
    output: ContactOutput = Field(default_factory=ContactOutput)
    joint: list[JointTable] = Field(default_factory=list)
    target: list[TargetTable] = Field(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _method_for_joints(cls, data: object) -> object:
        """Set the default method of scenes with joints."""
        if isinstance(data, dict) and data.get("joint"):
            solver = data.get("solver", {})
            if isinstance(solver, dict):
                return {**data, "solver": {"method": JOINTED, **solver}}
        return data

    def body_numbers(self) -> list[int]:
        """Return the number among the bodies of each solid, and a final WORLD.

        WORLD for a solid that is no body.
        """
        moving = [solid.is_body for solid in self.solid]
        return [
            int(sum(moving[:index])) if body else WORLD for index, body in enumerate(moving)
        ] + [WORLD]

    def joints(self) -> list[Joint]:
        """Return the joints, with the numbers of their bodies."""
        return [table.to_joint(self.body_numbers()) for table in self.joint]

    def targets(self) -> list[TargetPath]:
        """Return the targets of inverse kinematics."""
        rows = [
            (table, np.array([[*row, 0.0][:3] for row in [table.point, *table.places]]))
            for table in self.target
        ]
        return [
            TargetPath(self.body_numbers()[table.solid], of[0], np.array(table.times), of[1:])
            for table, of in rows
        ]

    def find_errors(self) -> list[CrossKeyError]:
        """Return errors that involve several keys."""
        errors = super().find_errors()
        if not any(solid.is_body for solid in self.solid):
            errors.append(
                CrossKeyError(("solid",), None, "has no rigid body: give one a density or a mass")
            )
        for key in ("particles", "ids", "grid", "surface", "volume", "forces"):
            if getattr(self.output, key):
                errors.append(CrossKeyError(("output", key), True, f"must be false: {NO_MATERIAL}"))
        if self.physics.density != type(self.physics).model_fields["density"].default:
            errors.append(
                CrossKeyError(
                    ("physics", "density"),
                    self.physics.density,
                    f"{NO_MATERIAL}; density is a key of each [[solid]]",
                )
            )
        for key, usual in (("wall", "separating"), ("solids", "cut-cell"), ("follow", True)):
            if getattr(self.domain, key) != usual:
                errors.append(
                    CrossKeyError(
                        ("domain", key),
                        getattr(self.domain, key),
                        f"must be left out: {NO_MATERIAL}",
                    )
                )
        if self.solver.preset is not None:
            errors.append(
                CrossKeyError(
                    ("solver", "preset"),
                    self.solver.preset,
                    "must be left out for bodies alone: give time.dt_max and solver.tolerance",
                )
            )
        if self.solver.precision != "double":
            errors.append(
                CrossKeyError(("solver", "precision"), self.solver.precision, "must be double")
            )
        if self.solver.directions != 4 and self.solver.method not in STEWART_TRINKLE:
            incompatible = (
                "uses the circular cone"
                if self.solver.method in CONE
                else "uses the boxed friction model"
            )
            message = (
                f"is only for the methods {', '.join(STEWART_TRINKLE)}; {self.solver.method} "
                f"{incompatible}"
            )
            errors.append(CrossKeyError(("solver", "directions"), self.solver.directions, message))
        return (
            errors
            + (self._joint_errors() if self.joint else [])
            + (self._target_errors() if self.target else [])
        )

    def _target_errors(self) -> list[CrossKeyError]:
        """Return errors of targets and of the bodies that they move."""
        errors = [
            CrossKeyError(("target", index, *c.place), c.value, c.message)
            for index, table in enumerate(self.target)
            for c in table.find_errors(self.dimension, self.solid)
        ]
        if self.solver.method not in KINEMATIC:
            message = f"cannot be used for inverse kinematics; choose from {', '.join(KINEMATIC)}"
            errors.append(CrossKeyError(("solver", "method"), self.solver.method, message))
        for index, table in enumerate(self.joint):
            if table.motor_torque is not None:
                errors.append(
                    CrossKeyError(
                        ("joint", index, "motor_torque"),
                        table.motor_torque,
                        "must be left out: targets move the bodies",
                    )
                )
        if not errors and not self._joint_errors():
            try:
                tree_of(self.joints(), sum(solid.is_body for solid in self.solid))
            except ValueError as error:
                errors.append(CrossKeyError(("target",), None, str(error)))
        return errors

    def _joint_errors(self) -> list[CrossKeyError]:
        """Return errors of joints, and of keys that exclude joints."""
        errors = [
            CrossKeyError(("joint", index, *c.place), c.value, c.message)
            for index, table in enumerate(self.joint)
            for c in table.find_errors(self.dimension, self.solid)
        ]
        if self.solver.method in (DEFAULT, *CONE):
            message = (
                "cannot solve joints, which are equations; choose from "
                f"{', '.join((*BOXED, *STEWART_TRINKLE))}"
            )
            errors.append(CrossKeyError(("solver", "method"), self.solver.method, message))
        if self.domain.open:
            errors.append(
                CrossKeyError(
                    ("domain", "open"), self.domain.open, "must be left out in a scene with joints"
                )
            )
        for index, solid in enumerate(self.solid):
            if solid.restitution:
                errors.append(
                    CrossKeyError(
                        ("solid", index, "restitution"),
                        solid.restitution,
                        "must be 0 where there are joints",
                    )
                )
        return errors

    def plan(self) -> list[tuple[str, str]]:
        """Return a summary of the run."""
        shown_keys = {"preset", "open", "moving", "bodies", "time", "frames"}
        solver, moving = self.solver, sum(solid.is_body for solid in self.solid)
        model = "the circular cone" if solver.method in CONE else "boxes"
        model = (
            f"Stewart and Trinkle, {solver.directions} sides"
            if solver.method in STEWART_TRINKLE
            else model
        )
        return [
            *(
                (word, line)
                for word, line in super().plan()
                if word in shown_keys and (word != "bodies" or moving <= 8)
            ),
            *([("bodies", f"{moving} of {len(self.solid)} solids")] if moving > 8 else []),
            *([("joints", self._joint_line())] if self.joint else []),
            *([("targets", f"{len(self.target)}, of inverse kinematics")] if self.target else []),
            (
                "solver",
                f"{solver.method} to {solver.tolerance:g} rad, at most {solver.max_iterations} "
                "problems a step",
            )
            if self.target
            else (
                "solver",
                f"{solver.method} to {solver.tolerance:g}, at most {solver.max_iterations} "
                f"iterations; friction: {model}",
            ),
        ]

    def _joint_line(self) -> str:
        """Return the line of the plan about joints."""
        counts = {
            kind: sum(table.kind == kind for table in self.joint) for kind in get_args(JointKind)
        }
        motors, limited = (
            sum(getattr(table, key) is not None for table in self.joint)
            for key in ("motor_torque", "limits")
        )
        named = {f"{count} {kind}": count for kind, count in counts.items()} | {
            f"{limited} with limits": limited,
            f"{motors} with motors": motors,
        }
        return ", ".join(line for line, count in named.items() if count)
