"""Frames in the formats of ParaView, renderers and modelers."""
