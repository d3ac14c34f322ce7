"""Frames as ParaView, renderers and modelers open them."""
