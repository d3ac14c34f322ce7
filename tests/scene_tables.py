"""Tables of scenes."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from warp_lcp.scene.scene import SceneError


def box(low: Sequence[float], high: Sequence[float], **more: Any) -> dict[str, Any]:
    """Return a box of material or a solid one, as a table of a scene."""
    return {
        "shape": "box",
        "min": np.asarray(low).tolist(),
        "max": np.asarray(high).tolist(),
        **more,
    }


def ball(center: Sequence[float], radius: float, **more: Any) -> dict[str, Any]:
    """Return a ball of material or a solid one, as a table of a scene."""
    return {"shape": "sphere", "center": center, "radius": radius, **more}


def scene_error(build: Callable[..., Any], *arguments: Any, **options: Any) -> str:
    """Return the text of the error by which a scene is refused."""
    with pytest.raises(SceneError) as caught:
        build(*arguments, **options)
    return str(caught.value)
