"""Rigid bodies: mass properties, motion, joints, contacts with friction."""
