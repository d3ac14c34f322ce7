"""Benchmark suites and their stored results.

`warp-lcp bench SUITE` finds the suites by the entry-point group `warp_lcp.benchmarks` and runs each
in a process of its own.
"""
