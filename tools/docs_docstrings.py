"""Docstrings as Markdown: examples become code, references lose their role, fields bring their comments (griffe)."""

from __future__ import annotations

import re
from itertools import takewhile
from typing import Any

from griffe import Class, Extension, Object


class PlainDocstrings(Extension):
    """Rewrite each docstring before it is read."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Change the text of one object."""
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)

    def on_class_members(self, *, cls: Class, **_: Any) -> None:
        """Say what the comments of the fields say, where the docstring does not."""
        comments = field_comments(cls).items()
        rows = ["    " + (text if text.startswith(f"{name}, ") else f"{name}: {text}") for name, text in comments]
        if rows and cls.docstring is not None and "\nAttributes:" not in cls.docstring.value:
            cls.docstring.value += "\n\nAttributes:\n" + "\n".join(rows)


def field_comments(cls: Class) -> dict[str, str]:
    """The comment beside each public field, or the lines above it."""
    comments = {}
    for name, field in cls.attributes.items():
        if name.startswith("_"):
            continue
        beside = re.search(r"  # (.+)$", "".join(field.lines[-1:]))
        above = list(
            takewhile(lambda line: line.strip().startswith("# "), cls.lines[field.lineno - cls.lineno - 1 :: -1])
        )
        if beside or above:
            comments[name] = beside[1] if beside else " ".join(line.strip()[2:] for line in reversed(above))
    return comments


def markdown(text: str) -> str:
    """Examples in fences, ``code`` and :func:`code` as `code`."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    return re.sub(
        r"(?:^>>> .*\n?(?:^(?!>>>|$).+\n?)*)+", lambda m: f"```python\n{m[0].rstrip()}\n```\n", text, flags=re.M
    )
