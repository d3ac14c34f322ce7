"""Mutation tests: change one place of the code and see whether a test fails.

The place is an operator, a number or a statement (`make mutants`).
"""
