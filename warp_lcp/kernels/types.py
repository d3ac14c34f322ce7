"""Types of annotations that Warp's own classes do not express."""

from typing import Any, TypeAlias

import warp as wp

DeviceArray: TypeAlias = wp.array[Any]
"""Warp array of any dtype and dimension, in the memory of the CPU or of a CUDA device.

The docstring of the function or class that uses it gives dtype and shape.
"""
