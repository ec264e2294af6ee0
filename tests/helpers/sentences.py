"""What bad input is answered with: one sentence."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from softgrasp.fem.errors import SoftgraspError


@contextmanager
def refused(sentence: str) -> Iterator[None]:
    """A block that must raise an error of one line that contains the sentence."""
    with pytest.raises((SoftgraspError, ValueError), match=re.escape(sentence)) as caught:
        yield
    assert "\n" not in str(caught.value).strip()
