// Move particles among walls that are given by their distance.
#include "particle_blocks.h"
#include "sample.h"
#include "wall_distance.h"
#include "project.h"
#include "march.h"
#include "runge_kutta.h"
