"""Model of time and memory of each solver by the number of unknowns and ranks.

`python -m benchmarks solvers` measures set-up and solves of every row and prints measured over modelled times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

SolverName = Literal["cholesky", "mumps", "cg", "stars"]
ITERATIVE = ("cg", "stars")

Power = tuple[float, float]  # value at 1e5 unknowns, and exponent of the number of unknowns
# Relative residual at which a step ends [1]. Smooth errors weigh little in the residual of a stiff matrix: of 276
# random linear scenes cg left up to 3.6e-2 of the deformation at 1e-4, 9.3e-7 at 1e-8.
STEP_RTOL = {"cg": 1e-8, "stars": 1e-4}
# Iterations of a step from the last solutions, over those from zero to 1e-8 [1].
GUESSED = {"cg": 0.6, "stars": 0.3}
FEW_SOLVES = 20  # solves of an equilibrium, a mesh estimate or modes with one factor [1]
PARALLEL = 0.62  # exponent p of the time ranks^-p of work spread over ranks [1]: 0.65 on two ranks, measured


@dataclass(frozen=True)
class Cost:
    """Cost of one solver on elements of one kind, on one core."""

    setup: Power  # time of the set-up [s]
    pass_: Power  # time of a solve by a factor, or of one iteration [s]
    memory: Power  # memory of set-up and factor [byte per unknown]
    most: float  # largest number of unknowns at which the solver is a candidate [1]; a factor does not fit beyond
    fixed: float = 0.0  # time of the set-up that does not depend on the size [s]
    iterations: tuple[float, float] = (1.0, 0.0)  # a, b of a + b sqrt(lambda / mu) iterations from zero to 1e-8 [1]


# By solver, dimension and whether the order is 2 or more. Times of direct solvers follow their entries: n log n and
# n^1.5 in 2D, n^(4/3) and n^2 in 3D, but for the caches; memory of factors is nnz(L) of factor_bytes.
COSTS: dict[tuple[SolverName, int, bool], Cost] = {
    ("cholesky", 2, False): Cost((0.67, 1.5), (0.0127, 1.1), (800, 0.1), 2e5),
    ("cholesky", 2, True): Cost((0.9, 1.5), (0.017, 1.1), (1000, 0.1), 2e5),
    ("mumps", 2, False): Cost((0.40, 1.25), (0.030, 0.97), (1000, 0.1), 4e6, fixed=0.033),
    ("mumps", 2, True): Cost((0.55, 1.25), (0.035, 0.97), (1250, 0.1), 4e6, fixed=0.033),
    ("cg", 2, False): Cost((0.25, 1.0), (0.006, 1.12), (600, 0.0), np.inf, iterations=(9, 9.6)),
    ("cg", 2, True): Cost((0.6, 1.0), (0.02, 1.0), (1000, 0.0), np.inf, iterations=(16, 16)),
    ("stars", 2, True): Cost((1.2, 1.0), (0.02, 1.0), (900, 0.0), np.inf, iterations=(7.4, 3.75)),
    ("cholesky", 3, False): Cost((37.0, 2.0), (0.11, 1.5), (13_000, 1 / 3), 2e4),
    ("cholesky", 3, True): Cost((37.0, 2.0), (0.11, 1.5), (13_000, 1 / 3), 2e4),
    ("mumps", 3, False): Cost((13.1, 2.0), (0.158, 1.5), (10_600, 1 / 3), 3e5, fixed=0.033),
    ("mumps", 3, True): Cost((12.8, 2.0), (0.144, 4 / 3), (10_600, 1 / 3), 3e5, fixed=0.033),
    ("cg", 3, False): Cost((0.8, 1.0), (0.022, 1.0), (900, 0.0), np.inf, iterations=(9, 9.6)),
    ("cg", 3, True): Cost((2.0, 1.0), (0.080, 1.0), (1500, 0.0), np.inf, iterations=(16, 16)),
    ("stars", 3, True): Cost((2.8, 1.17), (0.044, 1.2), (1400, 0.0), np.inf, iterations=(7.4, 3.75)),
}


@dataclass(frozen=True)
class Work:
    """Size and number of the solves with one matrix."""

    n: int  # number of unknowns [1]
    dimension: int  # space dimension d
    order: int  # polynomial order of the elements
    ranks: int  # number of ranks [1]
    solves: int  # number of solves with the matrix [1]
    few: bool  # whether they are static solves to 1e-12, with half again the iterations of 1e-8; else time steps
    contrast: float  # largest lambda / mu of the materials [1]

    def memory(self, name: SolverName, copies: int = 1) -> float:
        """Modelled memory of set-up and factor over all ranks [byte]."""
        return copies * self.n * self._at(self._cost(name).memory)

    def setup(self, name: SolverName, spread: bool = True) -> float:
        """Modelled time of the set-up [s]."""
        cost = self._cost(name)
        return cost.fixed + self._at(cost.setup) * self._share(spread)

    def solve(self, name: SolverName, spread: bool = True) -> float:
        """Modelled time of one solve [s]."""
        seconds = self.solve_from_zero(name) * self._share(spread)
        return seconds * (1.5 if self.few else GUESSED[name]) if name in ITERATIVE else seconds

    def solve_from_zero(self, name: SolverName) -> float:
        """Modelled time of one solve on one rank, iterations from zero to 1e-8 [s]."""
        cost = self._cost(name)
        a, b = cost.iterations
        return float((a + b * np.sqrt(max(self.contrast, 0.0))) * self._at(cost.pass_))

    def seconds(self, name: SolverName, spread: bool = True) -> float:
        """Modelled time of set-up and solves [s]."""
        return self.setup(name, spread) + self.solves * self.solve(name, spread)

    def candidates(self) -> list[SolverName]:
        """Solvers of these elements that are measured at this size; few solves go to a factor while it fits."""
        kind = (2 if self.dimension < 3 else 3), self.order > 1  # systems without a mesh cost like those in 2D
        names = [name for (name, *of), cost in COSTS.items() if tuple(of) == kind and self.n <= cost.most]
        direct = [name for name in names if name not in ITERATIVE]
        return direct if self.few and direct else names

    def leanest(self) -> SolverName:
        """The candidate with the least modelled memory."""
        return min(self.candidates(), key=self.memory)

    def _cost(self, name: SolverName) -> Cost:
        high = self.order > 1 or name == "stars"
        return COSTS[name, 2 if self.dimension < 3 else 3, high]

    def _at(self, power: Power) -> float:
        value, exponent = power
        return float(value * (self.n / 1e5) ** exponent)

    def _share(self, spread: bool) -> float:
        return float(self.ranks**-PARALLEL) if spread else 1.0
