"""Scene tables of a liquid: wall drag and probes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from warp_lcp.scene.scene import CrossKeyError, Table, Vector
from warp_lcp.settings import NonNegative


class WallDragSettings(Table):
    """[wall_drag]: drag of walls with an unresolved boundary layer.

    Off without the table and without `drag` of a solid.
    """

    coefficient: NonNegative = Field(
        default=0.0,
        description="c_f of walls and solids, about 0.005: shear stress c_f / 2 rho u^2",
    )
    domain: NonNegative | None = Field(
        default=None, description="c_f of the domain's walls; default: coefficient"
    )


def _column_name(text: str) -> str:
    """Return a valid prefix of column names."""
    if not (text.isascii() and text.isidentifier()):
        raise PydanticCustomError(
            "name", 'must consist of letters, digits and "_", and not begin with a digit'
        )
    return text


class Probe(Table):
    """[[probe]]: measurement at a point in each step, in probes.csv."""

    name: Annotated[str, AfterValidator(_column_name)] = Field(
        description="prefix of its columns, as in NAME_pressure"
    )
    position: Vector = Field(description="point in the domain [m]")
    quantity: Literal["pressure", "velocity", "level"] = Field(
        description="level: height of the surface above the point, against gravity [m]"
    )

    def columns(self, dimension: int) -> tuple[str, ...]:
        """Return the column names of the probe."""
        parts = ("vx", "vy", "vz")[:dimension] if self.quantity == "velocity" else (self.quantity,)
        return tuple(f"{self.name}_{part}" for part in parts)


def probe_errors(
    probes: Sequence[Probe], size: Sequence[float], gravity: Sequence[float]
) -> list[CrossKeyError]:
    """Return errors of the probes in a domain of given sides [m] and gravity [m/s^2]."""
    errors = []
    for index, probe in enumerate(probes):
        place = ("probe", index, "position")
        if len(probe.position) != len(size):
            errors.append(
                CrossKeyError(
                    place, probe.position, f"must have {len(size)} entries, as domain.size has"
                )
            )
        elif not all(0.0 <= x <= side for x, side in zip(probe.position, size, strict=True)):
            errors.append(
                CrossKeyError(
                    place,
                    probe.position,
                    f"lies outside the domain, which extends from the origin to {list(size)} m",
                )
            )
        if any(
            (probe.name, probe.quantity) == (other.name, other.quantity) for other in probes[:index]
        ):
            message = (
                f"is also the name of another probe of the {probe.quantity}: log columns "
                "must differ"
            )
            errors.append(CrossKeyError(("probe", index, "name"), probe.name, message))
        if probe.quantity == "level" and not any(gravity):
            errors.append(
                CrossKeyError(
                    ("probe", index, "quantity"),
                    "level",
                    "needs gravity, along which it is measured",
                )
            )
    return errors
