"""Tables of scenes."""

from collections.abc import Sequence
from typing import Any


def box(low: Sequence[float], high: Sequence[float], **more: Any) -> dict[str, Any]:
    """Return a box of material or a solid one, as a table of a scene."""
    return {"shape": "box", "min": low, "max": high, **more}
