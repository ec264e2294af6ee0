"""Model of time and memory of each solver by the number of unknowns and ranks.

`python -m benchmarks solvers` measures set-up and solves of every row and prints measured over modelled times;
`python -m benchmarks scale` does so for whole runs and on ranks. Of work that p ranks share each does 1 / p and some
for the seams, like (n / p)^(-1/d); of a factor p^-0.62 of the time of one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

SolverName = Literal["cholesky", "mumps", "cg", "stars"]
ITERATIVE = ("cg", "stars")

Reproducible = Literal["auto"] | bool

Power = tuple[float, float]  # value at 1e5 unknowns, and exponent of the number of unknowns
# Relative residual at which a step ends [1]. Smooth errors weigh little in the residual of a stiff matrix: of 276
# random linear scenes cg left up to 3.6e-2 of the deformation at 1e-4, 9.3e-7 at 1e-8.
STEP_RTOL = {"cg": 1e-8, "stars": 1e-4}
# Iterations of a step from the last solutions over those from zero to 1e-8, a / (1 + N / b) with N steps of a motion,
# by solver and whether steps are damped [1]: measured at N = 20, 50, 200 and 600, to 1.4.
GUESSED = {("cg", False): (0.8, 300), ("cg", True): (0.55, 250),
           ("stars", False): (0.32, 1000), ("stars", True): (0.22, 90)}  # fmt: skip
# Unknowns from which what iterates is a candidate: smaller ones were not measured, and a factor leaves more digits.
ITERATED_FROM = 20_000
GRADED = 2.5  # iterations on lines that crowd over those on even cells [1]: cg 2.2 to 2.6, stars 2.8
FEW_SOLVES = 20  # solves of equilibrium, mesh estimate or modes with one factor, and of all where it is shared [1]
UNKNOWN = 1e8  # contrast of matrices whose iterations the model does not know: a factor, while one is a candidate [1]
PARALLEL = 0.62  # exponent p of the time ranks^-p of a factor spread over ranks [1]: 0.65 on two ranks, measured
SEAMS = {2: 0.1, 3: 0.32}  # share of work at the seams between ranks of 1e5 unknowns each, by dimension [1]
MESSAGE = 2e-6  # time of a message between nodes [s]: a network's, not measured here
# By dimension and order: seconds to build a cell, and entries of K an unknown.
BUILD = {(2, 1): 3.5e-6, (2, 2): 1.7e-5, (2, 3): 5.4e-5, (2, 4): 2e-4,
         (3, 1): 7e-6, (3, 2): 9e-5, (3, 3): 6.7e-4, (3, 4): 3.5e-3}  # fmt: skip
ENTRIES = {(2, 1): 14, (2, 2): 23, (2, 3): 34, (2, 4): 46, (3, 1): 40, (3, 2): 77, (3, 3): 123, (3, 4): 198}
PER_ENTRY = 1e-9  # time of an entry in a product [s]
# Unknowns times ranks up to which every rank stores the whole factor of MUMPS, and ranks. On two ranks a spread one
# needs 0.68 and 0.65 of the time for solve and set-up at 2e4 unknowns in 3D; a whole one on each 1.4 and 1.2, and the
# memory of one for each, the price of the same bits. Of a whole run with 12 270 unknowns two ranks take 0.94 with a
# spread factor, 1.3 with whole ones. In 2D blocks on every rank beat MUMPS.
REPEATED_LIMIT = {2: 1_000_000, 3: 20_000}
REPEATED_RANKS = 4
# Unknowns from which ranks factor a subtree each in 2D: a solve with 1e5 takes 6.9 ms on two ranks, 11.3 on one, and
# 12.7 where both have the whole factor; below, the messages and the sum of a step take as long.
SUBTREES_FROM = 10_000
# Time of their set-up on two ranks over the model's of one factor [1]: 0.57 and 0.51 with 1e5 and 4e5 unknowns (0.34
# and 2.45 s of processor time; one factor 0.54 and 4.05).
SUBTREES_SETUP = 0.55
SUBTREES_MEMORY = 2.1  # memory of their set-up over that of one factor [1]: 2.1 and 2.0 with 1e5 and 4e5 unknowns


@dataclass(frozen=True)
class Cost:
    """Modelled time of one solver on elements of one kind, on one core."""

    setup: Power  # time of the set-up [s]
    pass_: Power  # time of a solve by a factor, or of one iteration [s]
    memory: Power  # memory of set-up and factor [byte per unknown]
    most: float  # largest number of unknowns at which the solver is a candidate [1]; a factor does not fit beyond
    fixed: float = 0.0  # time of the set-up that does not depend on the size [s]
    iterations: tuple[float, float] = (1.0, 0.0)  # a, b of a + b sqrt(lambda / mu) iterations from zero to 1e-8 [1]
    messages: float = 0.0  # messages of one pass that wait for each other, over the binary logarithm of the ranks [1]


# By solver, dimension and the order from which it holds. Messages of iterations are counted on 2 to 8 ranks, those of
# a factor guessed. Times of direct solvers follow their entries: n log n and n^1.5 in 2D, n^(4/3) and n^2 in 3D, but
# for the caches; memory of factors is nnz(L) of factor_bytes. With 1e6 unknowns in 2D cholesky takes 20 s and 0.19 s,
# MUMPS 11 s and 0.37 s, and both the same memory; beyond it was not measured. Stars were measured from 2e4 to
# 3.2e5 unknowns of P2 and with 2e4 and 7e4 of P3, cg of P3 with 9e3 and 2e4, where factors take the time of P2 to 1.2.
COSTS: dict[tuple[SolverName, int, int], Cost] = {
    ("cholesky", 2, 1): Cost((0.6, 1.5), (0.0125, 1.18), (800, 0.1), 1.2e6),
    ("cholesky", 2, 2): Cost((0.57, 1.5), (0.0138, 1.12), (1000, 0.1), 1.2e6),
    ("mumps", 2, 1): Cost((0.5, 1.33), (0.029, 1.1), (1000, 0.1), 4e6, fixed=0.033, messages=100),
    ("mumps", 2, 2): Cost((0.6, 1.28), (0.0275, 1.07), (1250, 0.1), 4e6, fixed=0.033, messages=100),
    ("cg", 2, 1): Cost((0.3, 1.12), (0.0105, 1.15), (600, 0.0), np.inf, iterations=(9, 9.6), messages=22),
    ("cg", 2, 2): Cost((0.6, 1.0), (0.02, 1.0), (1000, 0.0), np.inf, iterations=(16, 16), messages=22),
    ("stars", 2, 2): Cost((0.7, 1.0), (0.021, 1.0), (900, 0.0), np.inf, iterations=(7.4, 3.75), messages=110),
    ("cholesky", 3, 1): Cost((37.0, 2.0), (0.11, 1.5), (13_000, 1 / 3), 2e4),
    ("cholesky", 3, 2): Cost((37.0, 2.0), (0.11, 1.5), (13_000, 1 / 3), 2e4),
    ("mumps", 3, 1): Cost((13.1, 2.0), (0.158, 1.5), (10_600, 1 / 3), 3e5, fixed=0.033, messages=100),
    ("mumps", 3, 2): Cost((12.8, 2.0), (0.144, 4 / 3), (10_600, 1 / 3), 3e5, fixed=0.033, messages=100),
    ("cg", 3, 1): Cost((1.6, 1.15), (0.029, 1.15), (900, 0.0), np.inf, iterations=(9, 9.6), messages=22),
    ("cg", 3, 2): Cost((2.4, 1.22), (0.058, 1.2), (1200, 0.0), np.inf, iterations=(16, 16), messages=22),
    ("stars", 3, 2): Cost((1.3, 1.2), (0.040, 1.17), (1700, 0.0), np.inf, iterations=(7.4, 3.75), messages=110),
    ("cg", 3, 3): Cost((2.0, 1.0), (0.06, 1.0), (1100, 0.0), np.inf, iterations=(16, 27), messages=22),
    ("stars", 3, 3): Cost((4.0, 1.05), (0.084, 1.08), (6500, 0.0), np.inf, iterations=(7.4, 3.75), messages=110),
}


@dataclass(frozen=True)
class Work:
    """Size and number of the solves with one matrix."""

    n: float  # number of unknowns [1]
    dimension: int  # space dimension d
    order: int  # polynomial order of the elements
    ranks: int  # number of ranks [1]
    solves: int  # number of solves with the matrix [1]
    few: bool  # whether they are static solves to 1e-12, with half again the iterations of 1e-8; else time steps
    contrast: float  # largest lambda / mu of the materials [1]
    reproducible: Reproducible = "auto"  # time.reproducible of the scene
    graded: bool = False  # whether cells crowd, so that they are flat and iterations more
    damped: bool = False  # whether steps are damped, so that the last solutions predict the next better
    linear: bool = False  # whether they are linear steps without contact, whose factor may have a subtree on each rank
    direct: bool = False  # whether a factor is used while one is a candidate: contact, nonlinear laws, layers

    def repeated(self, name: SolverName) -> bool:
        """Whether every rank factors by itself: no message in a solve, and the same bits in every run.

        The distributed factor of MUMPS needs less memory, but adds in the order messages arrive, so that its last bits
        differ from run to run.
        """
        if name == "cholesky":
            return not self.split(name)
        if self.ranks == 1 or name in ITERATIVE:
            return False
        if self.reproducible != "auto":
            return bool(self.reproducible)
        return self.ranks <= REPEATED_RANKS and self.n * self.ranks <= REPEATED_LIMIT[self._kind]

    def split(self, name: SolverName) -> bool:
        """Whether each rank factors a subtree (`softgrasp.fem.solve.subtrees`)."""
        few = 2 <= self.ranks <= REPEATED_RANKS and self.n >= SUBTREES_FROM
        return name == "cholesky" and self.linear and self.dimension == 2 and few

    def memory(self, name: SolverName) -> float:
        """Modelled memory of set-up and factor over all ranks [byte]."""
        return self.copies(name) * self.n * self._at(self._cost(name).memory)

    def copies(self, name: SolverName) -> float:
        """Memory of set-up and factor over all ranks, over that of one factor [1]."""
        if self.split(name):
            return SUBTREES_MEMORY
        return self.ranks if self.repeated(name) else 1

    def setup(self, name: SolverName) -> float:
        """Modelled time of the set-up [s]."""
        cost = self._cost(name)
        again = SUBTREES_SETUP * 2**PARALLEL if self.split(name) else 1.0
        return cost.fixed + again * self._time(cost.setup, name) + self._waits(name)

    def solve(self, name: SolverName) -> float:
        """Modelled time of one solve [s]."""
        passes = 1.0
        if name in ITERATIVE:
            passes = max(self.iterations(name) * self.share(name), 1.0)
        return passes * (self._time(self._cost(name).pass_, name) + self._waits(name))

    def share(self, name: SolverName) -> float:
        """Iterations of a solve over those from zero to 1e-8 [1]; a step begins with the last solutions."""
        if self.few:
            return 1.5
        first, steps = GUESSED[name, self.damped]
        return first / (1 + self.solves / steps)

    def iterations(self, name: SolverName) -> float:
        """Modelled iterations from zero to 1e-8 [1]; 1 by a factor."""
        a, b = self._cost(name).iterations
        return float(a + b * np.sqrt(max(self.contrast, 0.0))) * (GRADED if self.graded else 1.0)

    def product(self, entries: float) -> float:
        """Modelled time of a product with a matrix of so many entries an unknown [s]."""
        return PER_ENTRY * entries * self.n * seams(self.n, self._kind, self.ranks)

    def seconds(self, name: SolverName) -> float:
        """Modelled time of set-up and solves [s]."""
        return self.setup(name) + self.solves * self.solve(name)

    def candidates(self) -> list[SolverName]:
        """Solvers of these elements that are measured at this size."""
        names = dict.fromkeys(name for name, d, least in COSTS if d == self._kind and least <= self.order)
        fitting = [name for name in names if self.n <= self._cost(name).most]
        factors = [name for name in fitting if name not in ITERATIVE]
        return factors if factors and (self.direct or self.n < ITERATED_FROM) else fitting

    def leanest(self) -> SolverName:
        """The candidate with the least modelled memory."""
        return min(self.candidates(), key=self.memory)

    def choose(self, memory: float = np.inf) -> list[SolverName]:
        """Candidates whose set-up and factor need at most so much over all ranks [byte], the fastest first.

        Where none does it is the one that needs the least.
        """
        fits = [name for name in self.candidates() if self.memory(name) <= memory]
        return sorted(fits or [self.leanest()], key=self.seconds)

    def solver(self, requested: str = "auto", memory: float = np.inf) -> SolverName:
        """The solver of a scene's choice: the fastest that fits, unless another is requested."""
        return self.choose(memory)[0] if requested == "auto" else requested  # type: ignore[return-value]

    def reason(self, requested: str = "auto", memory: float = np.inf) -> str:
        """The reason of that choice in words."""
        if requested != "auto":
            return "requested by the scene"
        best, *others = self.choose(memory)
        text = f"about {self.seconds(best):.2g} s for set-up and {self.solves} solves of n_e = {self.n:.0f}"
        return text + (f" by the cost model, {others[0]} {self.seconds(others[0]):.2g} s" if others else "")

    def price_of_bits(self, name: SolverName) -> str:
        """Time that a spread factor would save, in words; empty where each rank storing the whole one is as quick."""
        spread = replace(self, reproducible=False)
        if name == "cholesky" or not self.repeated(name) or spread.seconds(name) > self.seconds(name):
            return ""
        return (
            f"; each of the {self.ranks} ranks stores the whole factor, for the same bits in every run: with "
            f"time.reproducible = false about {spread.seconds(name):.2g} instead of {self.seconds(name):.2g} s"
        )

    @property
    def _kind(self) -> int:
        return 2 if self.dimension < 3 else 3  # systems without a mesh count as those in 2D

    def _cost(self, name: SolverName) -> Cost:
        kinds = ((name, self._kind, least) for least in (min(self.order, 3), 2, 1))
        return next(COSTS[kind] for kind in kinds if kind in COSTS)

    def _at(self, power: Power) -> float:
        value, exponent = power
        return float(value * (self.n / 1e5) ** exponent)

    def _time(self, power: Power, name: SolverName) -> float:
        """Time on these ranks without messages [s]; that of an iteration for an unknown grows with a rank's share."""
        if self.repeated(name):
            return self._at(power)
        if name not in ITERATIVE:
            return self._at(power) * float(self.ranks**-PARALLEL)
        return replace(self, n=self.n / self.ranks)._at(power) * self.ranks * seams(self.n, self._kind, self.ranks)

    def _waits(self, name: SolverName) -> float:
        """Least time of the messages of one pass [s]."""
        return 0.0 if self.repeated(name) else self._cost(name).messages * math.log2(self.ranks) * MESSAGE


def seams(n: float, dimension: int, ranks: int) -> float:
    """Time of products and assembly of n unknowns on some ranks over that on one [1]."""
    if ranks == 1:
        return 1.0
    return float((1 + SEAMS[dimension] * (n / ranks / 1e5) ** (-1 / dimension)) / ranks)
