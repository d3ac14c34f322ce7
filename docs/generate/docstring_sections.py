"""Docstrings as the site shows them: an extension of Griffe, which reads the sources for mkdocstrings."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object


class ExampleSections(Extension):
    """Makes `Example:` the section that Griffe calls `Examples:`, so that doctests are shown as code."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Rename the section of one object's docstring."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(
                r"^Example:$", "Examples:", obj.docstring.value, flags=re.M
            )
