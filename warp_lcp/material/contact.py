"""How a cell of material touches walls: what its walls would allow, and what the last solve made of it."""

TOUCHES_NOTHING = 0  # no solid face
HELD = 1  # a wall cell whose material stays on its walls
RELEASED = 2  # a wall cell whose material is leaving

TOUCHES = 1  # bits of `touch`: a face of the cell is not open,
LETS_GO = 2  # and one of those belongs to a wall that separates
