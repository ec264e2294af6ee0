"""Bounds at many parameters by two processes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from softgrasp.fem.forked import Forked, Pause, forked
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import Materials

PAYS = 0.05  # [s] of bounds from which a process is started: a fork, and copies of the pages that are written after it

Bounds = Callable[[Sequence[Materials], CertifiedModel], list[float]]


class TwoProcesses:
    """Bounds by this process and one that has the model since it was forked; each takes half of the parameters.

    Without a second core, or on several ranks, this process does everything. The numbers are the same.
    """

    def __init__(self, bounds: Bounds) -> None:
        self.bounds = bounds
        self.each = 0.0  # seconds of a bound, as the last ones took
        self.lost = False  # a process: no other is started
        self._model: CertifiedModel | None = None
        self._other: Forked[None] | None = None

    def __call__(self, many: Sequence[Materials], model: CertifiedModel) -> list[float]:
        """Bounds of a model at many parameters."""
        if model is not self._model:
            self.end()
        if self._other is None and not self.lost and len(many) > 1 and len(many) * self.each > PAYS:
            self._model, self._other = model, forked(lambda pause: self._serve(pause, model))
        begin = time.perf_counter()
        if self._other is None:
            values = self.bounds(many, model)
            self.each = (time.perf_counter() - begin) / max(len(many), 1)
            return values
        values = [0.0] * len(many)
        try:
            if self._other.state == "running":
                self._other.wait()
            self._other.go_on(many[1::2])
            values[::2] = self.bounds(many[::2], model)
            self.each = (time.perf_counter() - begin) / len(many[::2])
            values[1::2] = self._other.wait()
        except OSError:
            self.lost = True
            self.end()
            return self.bounds(many, model)
        return values

    def _serve(self, pause: Pause, model: CertifiedModel) -> None:
        values: list[float] = []
        while True:
            values = self.bounds(pause(values), model)

    def end(self) -> None:
        """End the other process."""
        if self._other is not None:
            self._other.end()
        self._model = self._other = None
