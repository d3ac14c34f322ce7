"""Mutants: change one operator, number or statement of the code at a time and see whether a test notices (`make mutants`)."""
