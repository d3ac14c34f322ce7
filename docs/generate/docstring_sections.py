"""Extension of Griffe for the docstrings of the site.

Griffe reads the sources for mkdocstrings.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object


class ExampleSections(Extension):
    """Rename sections `Example:` to `Examples:`.

    Griffe shows doctests of such sections as code.
    """

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Rename the section of one object's docstring."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(
                r"^Example:$", "Examples:", obj.docstring.value, flags=re.M
            )
