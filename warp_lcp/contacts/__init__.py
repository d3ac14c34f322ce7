"""Rigid bodies in contact, without a material: the plug-in `contacts`."""

from warp_lcp.contacts.simulator import ContactSimulator

SIMULATOR = ContactSimulator()

__all__ = ["SIMULATOR", "ContactSimulator"]
