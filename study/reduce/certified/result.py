"""A certified model and smaller ones of its basis against full runs."""

from __future__ import annotations

from dataclasses import dataclass

from softgrasp.reduction import TestError


@dataclass(frozen=True)
class Size:
    """A certified model of k modes at all tests."""

    k: int  # modes of the answer
    k2: int  # modes of the basis that certifies it
    N: int  # dimension of the answer
    query: float  # median seconds of an answer with its certificate
    tested: tuple[TestError, ...]  # one a parameter

    def largest(self, key: str) -> float:
        """Over the tests."""
        return max(float(getattr(t, key)) for t in self.tested)


@dataclass(frozen=True)
class BoxCheck:
    """A certified model and smaller ones of its basis over the box."""

    own: Size  # the model as it was built
    sizes: tuple[Size, ...]  # in the order of k, ``own`` among them
    full: float  # median seconds of a full run with its factor
