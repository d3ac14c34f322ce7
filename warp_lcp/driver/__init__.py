"""Scene files, the run loop, frames, logs, checkpoints and the command line."""
