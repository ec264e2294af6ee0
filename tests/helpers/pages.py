"""Words of a page as they were written: no-break spaces are spaces, names in the type of code have their marks."""

from __future__ import annotations

import html
import re
from pathlib import Path


def words_of(page: Path) -> str:
    """Text of an HTML file, tags included."""
    return html.unescape(re.sub("</?code>", "`", page.read_text())).replace("\u00a0", " ")
