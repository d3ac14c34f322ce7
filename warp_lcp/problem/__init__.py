"""The problem, what it is solved to, and the one loop that solves it."""
