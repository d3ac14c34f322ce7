"""Rigid bodies among the material: mass and inertia of a scene's shapes, their motion, and contacts between them and with walls."""
