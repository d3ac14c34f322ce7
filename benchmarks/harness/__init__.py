"""Shared parts of all suites: timing, machine, records, reports, comparisons."""
