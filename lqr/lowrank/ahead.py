"""Factors of the next shifts, made by threads while the present one solves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import scipy.sparse.linalg


class FactorsAhead:
    """A few threads of one factor each.

    SciPy frees the memory of a factor in the thread that made it and in no other, so each factor goes back there.

    Attributes:
        make: factor of S(p) at a shift p; the second argument is the number of the thread, for what it may overwrite.
        threads: executors of one thread each.
        coming: factors under way, by shift: number of the thread, and the future.
        maker: number of the thread that made the factor taken last.
    """

    def __init__(self, make: Callable[[complex, int], scipy.sparse.linalg.SuperLU], threads: int) -> None:
        self.make = make
        self.threads = [ThreadPoolExecutor(1) for _ in range(threads)]
        self.coming: dict[complex, tuple[int, Future[scipy.sparse.linalg.SuperLU]]] = {}
        self.maker = 0

    def take(self, shifts: Sequence[complex]) -> scipy.sparse.linalg.SuperLU:
        """The factor of the first shift; the others are begun as far as threads are idle.

        The caller hands its older factor to :meth:`free` before.
        """
        known = len(self.threads) - (shifts[0] not in self.coming)  # one thread has to be left for the first
        for p in [p for p in self.coming if p not in shifts[: 1 + known]]:
            self._drop(p)
        self._begin(shifts)
        self.maker, future = self.coming.pop(shifts[0])
        try:
            factor = future.result()
        finally:
            del future  # in a traceback it would keep everything alive that the caller references
        self._begin(shifts[1:])
        return factor

    def _drop(self, p: complex) -> None:
        self.maker = self.coming[p][0]
        self.free([self.coming.pop(p)])  # no name may refer to it when the thread lets it go

    def _begin(self, shifts: Sequence[complex]) -> None:
        for p in shifts[: 1 + len(self.threads)]:
            idle = set(range(len(self.threads))) - {i for i, _ in self.coming.values()}
            if p not in self.coming and idle:
                i = min(idle)
                self.coming[p] = (i, self.threads[i].submit(self.make, p, i))

    def free(self, box: list[object]) -> None:
        """Empty a list with the only reference to the last factor, in the thread that made it."""
        self.threads[self.maker].submit(box.clear)

    def close(self) -> None:
        """Finish what is under way and free it."""
        for p in list(self.coming):
            self._drop(p)
        for thread in self.threads:
            thread.shutdown()
