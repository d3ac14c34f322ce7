"""Atomic file writes, and safe reading of untrusted files."""
