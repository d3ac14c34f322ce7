"""Structs of fields for the stress kernels.

Components along z, and the second and third shear, are None in 2-D.
"""

from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True, slots=True)
class SandFields:
    """Packing of sand, see `granular.packing.Packing`.

    Attributes:
        flags: uint8 bits of each cell, 0 without sand.
        drive: free volume of each cell as a velocity [m/s], float32.
        stiff: bound of the friction's diagonal in a cell, float32.
        fraction: volume fraction of grains in each cell, float32.
        spans: first and one past the last cell of each row that stresses reach, int32.
        share_x: weight of a cell's copy on the edges of the first shear, float32.
        share_y: likewise of the second.
        share_z: likewise of the third.
        mass_x: mass of the faces along x, in units of a full face, float32.
        mass_y: likewise along y.
        mass_z: likewise along z.
        inverse_x: 1 / mass_x, 0 on faces that cannot move, float32.
        inverse_y: likewise along y.
        inverse_z: likewise along z.
        start_x: velocity along x before the stresses [m/s], float32.
        start_y: likewise along y.
        start_z: likewise along z.
    """

    flags: wp.array
    drive: wp.array
    stiff: wp.array
    fraction: wp.array
    spans: wp.array
    share_x: wp.array
    share_y: wp.array | None
    share_z: wp.array | None
    mass_x: wp.array
    mass_y: wp.array | None
    mass_z: wp.array | None
    inverse_x: wp.array
    inverse_y: wp.array | None
    inverse_z: wp.array | None
    start_x: wp.array
    start_y: wp.array | None
    start_z: wp.array | None


@dataclass(frozen=True, slots=True)
class VelocityFields:
    """Velocity of sand and its shears, see `stress.Velocity`; float32 or float64.

    Attributes:
        u_x: velocity along x on faces [m/s].
        u_y: likewise along y.
        u_z: likewise along z.
        edge_x: values of the first shear on edges: its stress, then twice its rate times dx [m/s].
        edge_y: likewise of the second.
        edge_z: likewise of the third.
        openings: open fractions of cells that solids cut, float32; None without such cells.
    """

    u_x: wp.array
    u_y: wp.array | None
    u_z: wp.array | None
    edge_x: wp.array
    edge_y: wp.array | None
    edge_z: wp.array | None
    openings: wp.array | None


@dataclass(frozen=True, slots=True)
class StressFields:
    """Stresses of a solve, float32, and the parameters of its steps.

    Attributes:
        now: the current stresses.
        before: the stresses before the last step.
        point: the point at which the next gradient is taken.
        past: the stresses of the last time step.
        momentum: momentum of the next steps, float64.
        numbers: parameters, float32, see `granular.stress_layout`.
    """

    now: wp.array
    before: wp.array
    point: wp.array
    past: wp.array
    momentum: wp.array
    numbers: wp.array


@dataclass(frozen=True, slots=True)
class WallFaces:
    """Faces of cells on solids.

    Attributes:
        cells: flat index of the cell of each face, int32.
        sides: side of the cell on which the face lies, uint8.
        walls: wall number, int32.
        friction: friction coefficient of each wall, float32.
    """

    cells: wp.array
    sides: wp.array
    walls: wp.array
    friction: wp.array
