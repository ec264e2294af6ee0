"""Structured Galerkin: the Riccati equation on a small second-order space of modes, static and frequency responses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, normalising, on_root, total
from softgrasp.lqr.lowrank import modal_start
from softgrasp.lqr.lowrank.definite import DefiniteTissue, well_damped
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.shifted import ShiftedTissue
from softgrasp.lqr.lowrank.shifts import frequency_estimate
from softgrasp.lqr.lowrank.solver import Iterate, LowRankSolver
from softgrasp.lqr.plant.block import Block

NEW = 1e-9  # share of a response that must be new to the space; smaller parts are rounding of the solve
ROUNDING = 1e-13  # of a Gram matrix: columns independent to 3e-7
# n_e from which shifts may be real: on a few dozen unknowns responses at real shifts soon depend on each other
DEFINITE_FROM = 5_000
BUDGET = 0.45  # share of omega at which a response's damping ratio is held below critical


@dataclass
class Space:
    """A displacement basis with its products, grown by blocks of columns."""

    V: Array  # basis, local rows (n_local, r)
    M_V: Array  # M_ee V, local rows (n_local, r)
    K_V: Array  # K_ee V, local rows (n_local, r)

    def grown(self, plant: Plant, columns: Array) -> Space:
        """With the parts of more columns that are new: M-orthogonal to V, which is M-orthonormal. Collective."""
        comm = plant.comm
        size = np.sqrt(total(comm, np.einsum("ij,ij->j", columns, plant.mass(columns))))
        columns = columns / np.where(size > 0, size, 1.0)
        M_columns = columns
        for _ in range(2):  # a small part is orthogonal to rounding only after it is scaled to 1
            for _ in range(2):  # twice is enough for orthogonality to rounding
                columns = columns - self.V @ total(comm, self.M_V.T @ columns)
            M_columns = plant.mass(columns)
            gram = total(comm, columns.T @ M_columns)
            S: Array = on_root(comm, partial(normalising, gram, ROUNDING, NEW**2))
            columns, M_columns = columns @ S, M_columns @ S
        more = (columns, M_columns, plant.stiff(columns))
        return Space(*(np.hstack([a, b]) for a, b in zip((self.V, self.M_V, self.K_V), more, strict=True)))

    def ritz(self, plant: Plant) -> tuple[Space, Array, Array]:
        """M-orthonormal Ritz basis V'M V = I, V'K V = diag(omega^2), omega, and S with new basis = V S. Collective."""
        r = self.V.shape[1]
        products = total(plant.comm, self.V.T @ np.hstack([self.M_V, self.K_V]))

        def rotate() -> tuple[Array, Array]:
            G, H = ((P + P.T) / 2 for P in (products[:, :r], products[:, r:]))
            squares, rotation = scipy.linalg.eigh(H, G)
            return np.sqrt(squares), rotation

        omega, S = on_root(plant.comm, rotate)
        return Space(self.V @ S, self.M_V @ S, self.K_V @ S), omega, S


@dataclass(frozen=True)
class Level:
    """One Galerkin space with its solution."""

    omega: Array  # frequencies of the basis [1/s], (r,)
    X: Array  # Riccati solution of the projected plant, (2 n_s + 2 r, 2 n_s + 2 r)
    Z: Block  # factor X ~ Z Z' in costate form, hand (2 n_s, rank), local rows (2 n_local, rank)
    a: Array  # displacement part of the gain, K_z' = K_ee a, local rows (n_local, m)
    b: Array  # velocity part of the gain, K_v' = M_ee b, local rows (n_local, m)
    gain: Block  # K' with unscaled z-row, hand (2 n_s, m), local rows (2 n_local, m)


def _root(X: Array) -> Array:
    """F with F F' = X, without the columns that are rounding."""
    values, vectors = np.linalg.eigh(X)
    keep = values > 1e-17 * values[-1]
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))


def _prolonged(plant: Plant, old: Level, S: Array, omega: Array) -> Array:
    """X of a level in the basis of the next: V_old = V_new T, T the columns of S^{-1} that the old basis filled."""
    s, r = 2 * plant.n_s, len(old.omega)
    T = np.linalg.inv(S)[:, :r]
    W = np.zeros((s + 2 * len(omega), s + 2 * r))
    W[:s, :s] = np.eye(s)
    W[s : s + len(omega), s : s + r] = omega[:, None] * T / old.omega
    W[s + len(omega) :, s + r :] = T
    return np.asarray(W @ old.X @ W.T)


def solve_level(plant: Plant, space: Space, old: Level | None = None) -> tuple[Level, Space]:
    """Project, solve and expand: X = W X_m W', W = blkdiag(I, I, K V / omega, V) on the costate. Collective.

    ``space``: the Ritz basis of ``old`` and more; ``old``: the level before, near the solution.
    """
    ritz, omega, S = space.ritz(plant)
    small = modal_start.restrict(plant, ritz.V, omega, ritz.M_V)
    X = modal_start.solve_small(plant, small, None if old is None else _prolonged(plant, old, S, omega))
    root = on_root(plant.comm, partial(_root, X))
    s, r = 2 * plant.n_s, len(omega)
    q, v = root[s : s + r] / omega[:, None], root[s + r :]
    Z = Block(root[:s], np.vstack([ritz.V @ q, ritz.V @ v]))
    small_gain = plant.inputs_of(Z)
    a, b = ritz.V @ (q @ small_gain), ritz.V @ (v @ small_gain)
    hand = np.vstack([root[: plant.n_s], plant.M_s @ root[plant.n_s : s]]) @ small_gain
    hand[plant.n_s :] += total(plant.comm, plant.G.T @ b)
    tall = np.vstack([ritz.K_V @ (q @ small_gain), ritz.M_V @ (v @ small_gain)])
    if plant.two_way:
        tall[plant.n_local :] += plant.G @ (root[plant.n_s : s] @ small_gain)
    return Level(omega, X, Z, a, b, Block(hand, tall)), ritz


def gain_change(plant: Plant, new: Level, old: Level) -> float:
    """Relative change of the gain, the larger of hand (2-norm) and tissue (dual energy norm). Collective."""
    comm = plant.comm

    def tissue(a: Array, b: Array) -> float:
        return float(np.sqrt(total(comm, np.array([np.sum(a * plant.stiff(a)) + np.sum(b * plant.mass(b))]))[0]))

    hand = 0.0
    if plant.n_s:
        hand = float(np.linalg.norm(new.gain.hand - old.gain.hand) / np.linalg.norm(new.gain.hand))
    size = tissue(new.a, new.b)
    change = max(hand, tissue(new.a - old.a, new.b - old.b) / size if size > 0 else 0.0)
    return float(comm.bcast(change))  # the same bits on every rank: they decide when all stop


def row_changes(plant: Plant, new: Level, old: Level) -> dict[str, float]:
    """Relative changes of the gain's rows of hand and tissue, Frobenius norms, beside which the hand hides. Collective.

    The tissue's part weighs as little in the whole gain as the tissue beside a heavy hand.
    """
    tall, whole = new.gain.tall - old.gain.tall, new.gain.tall
    change, size = np.sqrt(total(plant.comm, np.array([np.sum(tall**2), np.sum(whole**2)])))
    hand = np.linalg.norm(new.gain.hand) or 1.0
    return {
        "change_hand": float(np.linalg.norm(new.gain.hand - old.gain.hand) / hand),
        "change_tissue": float(change / (size or 1.0)),
    }


def frequencies(low: float, high: float, count: int) -> Array:
    """Points that fill [low, high] on a log scale evenly at every stage (van der Corput)."""
    from scipy.stats import qmc  # half a second, for large plants only

    return np.asarray(low * (high / low) ** qmc.Halton(1, scramble=False).random(count + 1)[1:, 0])


@dataclass(frozen=True, kw_only=True)
class StructuredGalerkin(LowRankSolver[tuple[Space, Array]]):
    """Galerkin on z = V eta, v_z = V eta' with V of modes and responses to the outputs.

    V starts with the lowest modes and K_ee^{-1} C_z and grows by S(p)^{-1} C_z at |p| between the last mode and the
    highest one, until the gain changes by less than the tolerance between two spaces, or the space is all of the
    tissue's. The shifts are real where damping keeps the poles of the modes left out away from the imaginary axis, so
    that S(p) is definite; elsewhere each takes a complex solve. The small problem keeps the second-order form and the
    energy, so it is stable whenever the tissue is damped. The true residual of such a solution is some 1e-3 in 2D
    although the gain is right to 1e-8, its tissue's part to 1e-5; residual and changes of both parts are reported, not
    checked.
    """

    method = "galerkin"
    by_residual = False
    tol: float = 1e-6  # bound on the relative change of the gain between the last two spaces, see gain_change
    max_iterations: int = 24  # bound on the number of spaces
    modes: int = modal_start.MODES  # number of modes
    per_step: int = 2  # responses added at a time

    def prepare(self, plant: Plant) -> tuple[Space, Array]:
        """The space of the lowest modes, and their frequencies. Collective."""
        modal_start.check_damped(plant)
        omega, Phi = modal_start.plant_modes(plant, min(self.modes, plant.layout.n_e))
        return Space(Phi, plant.mass(Phi), plant.stiff(Phi)), omega

    def tissue_solver(self, plant: Plant, start: tuple[Space, Array]) -> ShiftedTissue:
        """Definite solves at real shifts where they serve. Collective."""
        real = plant.layout.n_e >= DEFINITE_FROM and well_damped(plant.system, _lowest(plant, start[1]))
        if self.tissue == "definite" or (self.tissue == "auto" and real):
            return DefiniteTissue(plant.system, _loads(plant).shape[1])
        return super().tissue_solver(plant, start)

    def iterate(self, plant: Plant, tissue: ShiftedTissue, start: tuple[Space, Array]) -> Iterate:
        """Spaces one after the other until the gain settles. Collective."""
        space, omega = start
        low = _lowest(plant, omega)
        high = max(frequency_estimate(plant.system), 2 * low)
        grid = frequencies(low, high, self.per_step * self.max_iterations).tolist()
        loads, real = _loads(plant), isinstance(tissue, DefiniteTissue)
        level, space = solve_level(plant, space)
        history, change, used, whole = list[dict[str, float]](), np.inf, 0, plant.layout.n_e
        if len(level.omega) == whole:
            history.append(
                {"basis": float(whole), "solve": 0.0, "change": 0.0, "change_hand": 0.0, "change_tissue": 0.0}
            )
        for i in range(self.max_iterations):
            if change <= self.tol or len(level.omega) == whole:
                break
            # the static response first; shift number k + 1 belongs to frequency number k
            take = (
                [0j]
                if i == 0
                else [complex(-w) if real else _response_shift(plant, w) for w in grid[used - 1 :][: self.per_step]]
            )
            rest = take[:]
            while rest:
                now = rest[: tissue.group(rest)]
                rest = rest[len(now) :]
                for p, response in zip(now, tissue.solve_each(now, [loads] * len(now), rest), strict=True):
                    parts = [response.real] if p.imag == 0 else [response.real, response.imag]
                    space = space.grown(plant, np.hstack(parts))
            used += len(take)
            if space.V.shape[1] < min(len(level.omega) + len(take), whole):  # nothing new: no evidence either
                continue
            new, space = solve_level(plant, space, level)
            change, rows, level = gain_change(plant, new, level), row_changes(plant, new, level), new
            self.record(history, {"basis": float(len(new.omega)), "solve": float(used), "change": change, **rows})
        order = len(level.omega)
        if not (change <= self.tol or order == whole):
            raise SolverError(
                f"galerkin: the gain still changes by {change:.1e} at {order} basis vectors, tolerance {self.tol:.0e}; "
                "allow more iterations, or use newton_adi"
            )
        settled = f"{order} basis vectors, gain settled to {history[-1]['change']:.1e}"
        about = f"all {order} basis vectors that there are" if order == whole else settled
        about += f", {tissue.about}"
        counts = {"solves": used, "basis": order, "spaces": len(history) + 1}
        return Iterate(level.Z, level.gain, about, history, counts)


def _lowest(plant: Plant, omega: Array) -> float:
    """Lowest frequency that the responses have to cover: where the modes do not decouple that of the first mode."""
    return float(omega[-1] if plant.viscous is None else omega[0])


def _loads(plant: Plant) -> Array:
    """Loads of the outputs, and two-way that of the reaction of the hand, local rows (n_local, k)."""
    return np.hstack([plant.C_z, plant.G]) if plant.two_way else plant.C_z


def _response_shift(plant: Plant, omega: float) -> complex:
    """Shift on the circle |p| = omega at the damping ratio of a mode there, at most :data:`BUDGET`."""
    damping = plant.system.damping
    beta = max([damping.beta, *(m.beta for m in plant.system.materials)])
    zeta = min(max((damping.alpha / omega + beta * omega) / 2, 1e-3), BUDGET)
    return complex(-zeta * omega, omega * np.sqrt(1 - zeta * zeta))
