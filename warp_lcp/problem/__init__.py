"""The problem, the stopping criteria, and the loop that solves it."""
