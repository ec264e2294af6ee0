"""Certificates of several gains of one plant, on ranks one gain a rank."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.petsc import Array, rows_on_all
from softgrasp.fem.solve.solvers import factor_on_every_rank
from softgrasp.fem.solve.stiffness import sharing_factors, static_solver
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.problem import RiccatiProblem, whole_problem
from softgrasp.lqr.spectrum.certificate import Abscissa, abscissa, centre
from softgrasp.lqr.spectrum.tail import tail_modes, why_no_bound

# Unknowns of the tissue up to which two gains and more are certified by one rank each, which needs the whole factor
# there; a single gain is where the factor is whole on every rank anyway.
MOST = {1: 50_000, 2: 50_000, 3: 20_000}


class Certificates:
    """:func:`softgrasp.lqr.spectrum.certificate.abscissa` of gains, which share modes, a shift and its factor.

    A step of an iteration for eigenvalues takes a fraction of a millisecond on a small plant, on ranks with seven
    messages; ranks that certify whole gains need none.

    Args:
        best: gain whose shift the others share.
    """

    def __init__(self, problem: RiccatiProblem, best: Gain) -> None:
        self.problem, self.comm, self.best = problem, problem.layout.comm, best
        self._shift: float | None = None  # of the last certificate that this rank took part in

    def of(self, gains: Sequence[Gain]) -> list[Abscissa | SolverError]:
        """The certificate of each gain, or why no eigenvalue converges. Collective."""
        if not self._divided(len(gains)):
            self._shift = self.comm.bcast(self._shift)  # ranks that certified gains by themselves have their own
            return [self._found(self.problem, gain, self._modes) for gain in gains]
        every = [self._whole_gain(gain) for gain in gains]
        plant, modes, best = self._whole
        own: dict[int, Abscissa | SolverError] = {}
        with raise_on_all_ranks(self.comm), sharing_factors(plant.system):
            for i in range(self.comm.rank, len(gains), self.comm.size):
                if self._shift is None and gains[i] is not self.best:
                    self._shift = centre(plant, best, modes)
                own[i] = self._found(plant, every[i], modes)
        found = {i: result for part in self.comm.allgather(own) for i, result in part.items()}
        return [found[i] for i in range(len(gains))]

    def _divided(self, count: int) -> bool:
        """Whether ranks certify gains by themselves. Collective."""
        layout = self.problem.layout
        if layout.comm.size == 1 or layout.n_e > MOST[layout.dimension]:
            return False
        return count > 1 or factor_on_every_rank(layout, static_solver(self.problem.system), "auto", linear=True)

    def _found(self, plant: RiccatiProblem, gain: Gain, modes: tuple[Array, Array] | None) -> Abscissa | SolverError:
        try:
            result = abscissa(plant, gain, modes, self._shift)
        except SolverError as error:
            return error
        self._shift = result.shift
        return result

    @cached_property
    def _modes(self) -> tuple[Array, Array] | None:
        """Modes that the certificates share; None where there is no bound. Collective."""
        return None if why_no_bound(self.problem) else tail_modes(self.problem)

    @cached_property
    def _whole(self) -> tuple[RiccatiProblem, tuple[Array, Array] | None, Gain]:
        """Plant, modes and best gain with all rows. Collective."""
        modes = self._modes
        if modes is not None:
            modes = modes[0], rows_on_all(self.comm, modes[1])
        return whole_problem(self.problem), modes, self._whole_gain(self.best)

    def _whole_gain(self, gain: Gain) -> Gain:
        return Gain(gain.K_s, rows_on_all(self.comm, gain.K_z), rows_on_all(self.comm, gain.K_v))
