"""Extras: connections of warp_lcp to other programs and libraries.

Only the command line imports them. They use documented modules.
"""
