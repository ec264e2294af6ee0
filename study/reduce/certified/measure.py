"""A certified model of several sizes against full runs over its box."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from statistics import median

import numpy as np

from softgrasp.fem import Model, Stopwatch
from softgrasp.reduction import CertifiedModel, TestError, measured_error, run_at
from softgrasp.study.shell import median_seconds

REPEATS = 7  # behind the median time of a query
TESTS, FEWER, LARGE = 5, 3, 20_000  # tests of each constant, and from so many unknowns on
SHARES = (1 / 12, 1 / 8, 1 / 6, 1 / 4, 1 / 3, 1 / 2)  # of the modes: sizes that are shown
SECOND = 3  # times as many modes in the basis that certifies, as far as there are
NEAR = 0.2  # of the model's own k: sizes that would hide it


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


def check_box(model: Model, certified: CertifiedModel) -> BoxCheck | None:
    """Full runs on a grid between the corners of the box, and every size against them. Collective.

    None where the bound is of tissue and hand together (a force on the hand, coupled both ways).
    """
    drive, reconstruction, box = certified.drive, certified.fine.reconstruction, certified.box
    if drive is None or reconstruction is None or box is None or (certified.fine.two_way and drive.hand is None):
        return None
    layout = model.system.layout
    drive, comm, Phi = replace(drive, finer=None), layout.comm, reconstruction.L_q[:, 2 * layout.n_s :]
    models = [certified.with_sizes(*sizes) for sizes in sizes_of(certified)]
    tests: list[list[TestError]] = [[] for _ in models]
    count = TESTS if layout.n_e < LARGE else FEWER
    inner = (np.arange(count) + 0.5) / count  # of the box; the training has its edges
    lam, mu = (low * (high / low) ** inner for low, high in (box.lam, box.mu))
    watch = Stopwatch(comm)
    for i, place in enumerate(product(lam.tolist(), mu.tolist())):
        with watch.stage(f"full run {i}"):
            full = run_at(model, *place)
        for part, own in zip(models, tests, strict=True):
            own.append(measured_error(full, part.run(full.model.system.materials, drive, allow=True), Phi[:, : part.k]))
    sizes = []
    for part, own in zip(models, tests, strict=True):
        query = median_seconds(comm, partial(part.run, allow=True), REPEATS)
        sizes.append(Size(part.k, part.k2, part.coarse.N, query, tuple(own)))
    built = next(s for s in sizes if (s.k, s.k2) == (certified.k, certified.k2))
    return BoxCheck(built, tuple(sizes), float(median(watch.seconds.values())))


def sizes_of(certified: CertifiedModel) -> list[tuple[int, int]]:
    """Pairs k, k2 that are shown: the model's own, and leading parts of its basis."""
    K = certified.k2
    pairs = {max(1, round(share * K)) for share in SHARES}
    own = {(k, min(SECOND * k, K)) for k in pairs if k < K and abs(k / certified.k - 1) > NEAR}
    return sorted({*own, (certified.k, certified.k2)})
