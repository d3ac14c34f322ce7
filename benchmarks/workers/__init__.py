"""Peers that need an interpreter of their own: programs that solve what they are asked on their input, a JSON line each.

Nothing here imports Warp or this project's packages: NumPy and the peer are all that such an interpreter has.
"""
