"""Scene files: tables, shapes, motions, presets, the prices of models."""
