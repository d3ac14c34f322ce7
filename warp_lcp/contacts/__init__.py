"""Rigid bodies that touch, without a material around them: a plug-in of warp_lcp."""

from warp_lcp.contacts.simulator import ContactSimulator

SIMULATOR = ContactSimulator()

__all__ = ["SIMULATOR", "ContactSimulator"]
