"""Docstrings as Markdown: examples become code, references lose their role. An extension of griffe for `make docs`."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object


class PlainDocstrings(Extension):
    """Rewrite each docstring before it is read."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Change the text of one object."""
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(text: str) -> str:
    """Examples in fences, ``code`` and :func:`code` as `code`."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    return re.sub(
        r"(?:^>>> .*\n?(?:^(?!>>>|$).+\n?)*)+", lambda m: f"```python\n{m[0].rstrip()}\n```\n", text, flags=re.M
    )
