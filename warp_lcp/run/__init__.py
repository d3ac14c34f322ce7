"""A run: its loop, folder, checkpoints, log, progress and devices, on one process or on ranks."""
