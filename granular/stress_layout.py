"""Yield set (friction cone) of sand: layout of stress fields, parameters, kernels.

The projection onto it is the snippet `yield` of `headers/sand.h`; each step of a stress solve
applies it to each cell. `granular.stress.YieldSet` has the values of a time step.

All stresses are impulses over rho dx [m/s]: x = kick_dt p / (rho dx), and the shear stresses alike,
so that equations contain neither spacing nor time step. A field of stresses has layers of the
grid's shape: x; the normal parts of the deviator (2-D: a = s_xx = -s_yy; 3-D: s_xx, s_yy, s_zz);
and for each shear four *copies* in each cell. Copy q of the shear of axes (alpha, beta) lies on the
cell's edge at the low (0) or high (1) side along alpha, q & 1, and along beta, q >> 1. Shears are
ordered xy, xz, yz. An edge is stored at the cell whose low side it is. Its stress is the mean of
the copies of the cells that take part in it. `share` has the weight of a copy: > 0 between cells;
< 0 on a wall, with the weight as its absolute value; 0 where there is no shear. Where solids cut
cells DIM more layers have the traction of the wall in a cell, see `granular.cut_walls`.
"""

import warp as wp

# Newton iterations for the multiplier of a yielding cell: 3 are exact to 2e-6 of the bound, 4 to
# rounding.
NEWTON = 4
COLUMNS = 8  # columns of the sums of a row, see `granular.stress_kernels`

# Slots of the kernels' parameters: yield set; dt g [m/s] (three entries); steps of the method
# relative to the diagonal; point of the gradient beyond the stresses, in units of the momentum's
# displacement; dt / dx [s/m]; growth of friction with the shear rate (snippet `rate_bound` of
# `sand.h`); factor from the stresses of the last time step to those that this one starts from;
# least error of a stress [m/s] in the estimate of the velocity's error.
FRICTION, COHESION, TENSION, WEIGHT, PRESSURE_STEP, SHEAR_STEP, LOOKAHEAD, STEP_OF_CELL = (
    0,
    1,
    2,
    3,
    6,
    7,
    8,
    9,
)
GAIN, HALFWAY, RATIO, UNSURE, NUMBERS = 10, 11, 12, 13, 14

HOLDS = 1  # bits of a cell: it holds sand, and so has a pressure,
SHEARS_HERE = 2  # it holds enough sand for shear stress,
FIRM = 4  # it is dense enough for cohesion,
PARTLY = 8  # a solid cuts it, or a cell beside it
# Free fraction of a cell below which the flux through its faces counts as volume, whatever the
# neighbors hold, see `sand.h`.
NEARLY = 0.05
LEAST_RADIUS = 1e-30  # radius [m/s] of a yield set that contains only zero

CONSTANTS = {
    "NEWTON": NEWTON,
    "COLUMNS": COLUMNS,
    "LEAST_RADIUS": LEAST_RADIUS,
    "FRICTION": FRICTION,
    "COHESION": COHESION,
    "TENSION": TENSION,
    "WEIGHT": WEIGHT,
    "PRESSURE_STEP": PRESSURE_STEP,
    "SHEAR_STEP": SHEAR_STEP,
    "LOOKAHEAD": LOOKAHEAD,
    "HOLDS": HOLDS,
    "SHEARS_HERE": SHEARS_HERE,
    "FIRM": FIRM,
    "PARTLY": PARTLY,
    "STEP_OF_CELL": STEP_OF_CELL,
    "NEARLY": NEARLY,
    "GAIN": GAIN,
    "HALFWAY": HALFWAY,
    "RATIO": RATIO,
    "UNSURE": UNSURE,
}

F64, U8, I32 = wp.float64, wp.uint8, wp.int32
