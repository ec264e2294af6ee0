"""What a certified model says over its box, beside the truth: full runs at parameters that it was not trained at."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.errors import full_energy
from softgrasp.reduction.parameters import run_at
from softgrasp.reduction.replay import FullRun
from softgrasp.study.shell.timing import median_seconds, timed

TESTS, FEWER, LARGE = 5, 3, 20_000  # tests of each constant, and from so many unknowns on
SHARES = (1 / 12, 1 / 8, 1 / 6, 1 / 4, 1 / 3, 1 / 2)  # of the modes: sizes that are shown
SECOND = 3  # times as many modes in the basis that certifies, as far as there are
NEAR = 0.2  # of the model's own k: sizes that would hide it
REPEATS = 5  # behind the median time of a query


@dataclass(frozen=True)
class Tested:
    """One size at one parameter; errors relative to the largest energy norm of the full run."""

    lam: float  # lam, mu: [Pa]
    mu: float
    truth: float  # against the full run
    bound: float  # proved
    estimate: float  # difference of the two bases; nan with one

    @property
    def effectivity(self) -> float:
        """Bound over truth."""
        return self.bound / self.truth if self.truth > 0 else float("nan")


@dataclass(frozen=True)
class Size:
    """A certified model of k modes at all tests."""

    k: int  # k, k2: modes of the answer, and of the basis that certifies it
    k2: int
    N: int  # dimension of the answer
    query: float  # median seconds of an answer with its certificate
    tested: tuple[Tested, ...]  # one a parameter

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

    None where the bound is of tissue and hand together (a force on the hand, coupled both ways), or nothing moves.
    """
    drive, lift, box = certified.drive, certified.fine.lift, certified.box
    if drive is None or lift is None or box is None or (certified.fine.two_way and drive.hand is None):
        return None
    hand, comm, drive = 2 * model.system.layout.n_s, model.system.layout.comm, replace(drive, finer=None)
    Phi = lift.L_q[:, hand : hand + certified.k2]
    models = [certified.with_sizes(k, k2) for k, k2 in sizes_of(certified)]
    found: list[list[Tested]] = [[] for _ in models]
    count = TESTS if model.system.layout.n_e < LARGE else FEWER
    inner = (np.arange(count) + 0.5) / count  # of the box; the training has its edges
    places = [(box.lam[0] * (box.lam[1] / box.lam[0]) ** a, box.mu[0] * (box.mu[1] / box.mu[0]) ** b)
              for a in inner for b in inner]  # fmt: skip
    seconds: list[float] = []
    for lam, mu in places:
        run: list[FullRun] = []
        seconds.append(timed(comm, lambda place=(lam, mu), run=run: run.append(run_at(model, *place))))  # type: ignore[misc]
        full = run[0]
        size, steps = float(np.sqrt(2 * full.energy.max())), full.snapshots.steps
        if size == 0:
            return None
        for part, tests in zip(models, found, strict=True):
            answer = part.run(full.model.system.materials, drive, allow=True)
            a, b = np.split(answer.trajectory.x[steps, hand:].T, 2)
            off = full.snapshots.Z - np.vstack([Phi[:, : part.k] @ a, Phi[:, : part.k] @ b])
            error = float(np.sqrt(2 * full_energy(full.model.system, off).max()))
            c = answer.certificate
            estimate = float("nan") if c.estimate is None else float(c.estimate.largest) / size
            tests.append(Tested(lam, mu, error / size, float(c.energy.largest) / size, estimate))
    sizes = []
    for part, tests in zip(models, found, strict=True):
        query = median_seconds(comm, lambda part=part: part.run(allow=True), REPEATS)  # type: ignore[misc]
        sizes.append(Size(part.k, part.k2, part.coarse.N, query, tuple(tests)))
    own = next(s for s in sizes if (s.k, s.k2) == (certified.k, certified.k2))
    return BoxCheck(own, tuple(sizes), float(median(seconds)))


def sizes_of(certified: CertifiedModel) -> list[tuple[int, int]]:
    """Pairs k, k2 that are shown: the model's own, and leading parts of its basis."""
    K = certified.k2
    pairs = {max(1, round(share * K)) for share in SHARES}
    own = {(k, min(SECOND * k, K)) for k in pairs if k < K and abs(k / certified.k - 1) > NEAR}
    return sorted({*own, (certified.k, certified.k2)})
