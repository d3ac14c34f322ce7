"""The staggered grid and what lives on it: fields, particles and their transfer, advection, solids as signed distance and as cells."""
