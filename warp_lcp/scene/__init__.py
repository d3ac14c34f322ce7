"""Scene files: tables, shapes, motions, presets, costs of models."""
