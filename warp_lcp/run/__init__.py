"""Run a scene: loop, folder, checkpoints, log, progress and devices."""
