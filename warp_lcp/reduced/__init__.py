"""What Newton-type and pivoting methods solve within a step: systems on the free unknowns, dense problems, nonsmooth maps."""
