"""Errors of outputs by duals, frequency by frequency on a circle, where the dual problem is small and smooth.

The error e of a run obeys the midpoint rule under the load -r of its residual, from rest. With the generating functions
X(zeta) = sum_n x_n zeta^n, |zeta| = exp(-sigma dt) < 1, that is, exactly and for all steps at once,

    A(s) E = -f R,   A(s) = K + s D + s^2 M,   s = (2 / dt) (1 - zeta) / (1 + zeta),   f = 2 zeta / (1 + zeta).

For any dual d of an output c and its residual rho = c - A d, as A is symmetric,

    c'E = -f d'R - f rho'A^-1 R,   |rho'A^-1 R| <= kappa |rho|_{K^-1} |R|_{K^-1},
    kappa = max over omega of 1 / |1 + beta s + (s^2 + alpha s) / omega^2|,   D = alpha M + beta K.

The first part is computed and corrects the output. The second is a product of two residuals [PG00]; as |y_n| is at most
exp(sigma t_n) times the mean of |Y| on the circle, it bounds what is left at every step. On L points of the circle the
output at n + L, n + 2 L, ... is added, exp(-sigma L dt) times as large; |e| <= dt sum |r|_{M^-1} bounds it. After the
last step the residual is led to zero, which no earlier step feels. d is Galerkin's in W = [Phi, Psi], with Psi from
static responses to c and the lowest modes over the box; or 0, where that is better. From an equilibrium the start
e_0 = -K^-1 r_0 is removed first, with the dual at s = 0.

The gain is that of a residual whose frequencies the duals resolve, as with damping. Without damping the residual rings
in all modes (on the paper's scene 99 % of it lies below the frequency of mode 713 of 956), and the bound of the energy
norm remains the better one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, on_root, times_columns, total
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.stiffness import factored_stiffness
from softgrasp.reduction.certified.bounds import lengths
from softgrasp.reduction.certified.motion import Drive, Materials, Motion, load_rows
from softgrasp.reduction.certified.oscillators import Modes, SecondOrder
from softgrasp.reduction.certified.residual import ResidualNorms, ResidualSpace
from softgrasp.reduction.galerkin import unit_coupling
from softgrasp.reduction.model import ReducedModel

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

DUALS, MODES = 60, 30  # vectors of Psi, and modes that it is made of at every parameter
LENGTH = 16  # runs that the circle spans, with sigma = 1 / run: what is added from beyond is e^-16 times as large
FREQUENCIES = 2000  # at most, at which duals are made: where the residual matters most
LARGEST = 20_000_000  # numbers on the circle, of which some copies of 16 byte are made
IGNORED = 2e-3  # of what the residual has on the circle may stay without duals, which divide a bound by about 100


@dataclass(frozen=True)
class OutputDuals:
    """What the dual problems of all outputs need; small arrays, equal on every rank."""

    blocks: SecondOrder  # K_mu, K_lambda, M and G of every layer in W, (L, w, w) and (L, w, n_s)
    C: Array  # outputs in W, (w, p)
    triangle: Array  # triangle in K_r^-1 of [static residual norm's columns, C, M_1, K_mu and K_lambda of Psi]


def dual_vectors(model: Model, places: Sequence[Materials], space: ResidualSpace, Phi: Array) -> Array:
    """Psi beside Phi: POD in K_r of static responses to the outputs and of modes, by what an output sees of them.

    Local rows (n_local, at most :data:`DUALS`). Collective.

    Raises:
        SolverError: a factorisation failed, or a mode did not converge.
    """
    C, comm, K = model.output_columns, model.system.layout.comm, space.system.K_ee
    count, parts = min(MODES, model.system.layout.n_e), []
    for place in places:
        system = model.system.with_materials(place)
        with factored_stiffness(system) as solver:
            parts.append(solver.columns(C))
        omega, modes = lowest_modes(system, count)
        seen = np.linalg.norm(total(comm, modes.T @ C), axis=1) / omega**2
        parts.append(modes * seen)
    X = np.asfortranarray(np.hstack(parts))
    K_Phi = times_columns(K, Phi)
    gram = total(comm, Phi.T @ K_Phi)
    whole = float(total(comm, (X * times_columns(K, X)).sum(axis=0)).max())
    for _ in range(2):
        X = X - Phi @ np.linalg.solve(gram, total(comm, K_Phi.T @ X))
    X = np.asfortranarray(X)
    products = total(comm, X.T @ times_columns(K, X))
    squares, V = on_root(comm, lambda: np.linalg.eigh(products))
    # what is shorter than 1e-6 of a vector before the projection may be rounding of Phi, and W singular with it
    pick = [j for j in range(len(squares) - 1, -1, -1) if squares[j] > 1e-12 * whole][:DUALS]
    return np.asfortranarray(X @ (V[:, pick] / np.sqrt(squares[pick])))


def output_duals(model: Model, places: Sequence[Materials], space: ResidualSpace, Phi: Array) -> OutputDuals:
    """Duals for the basis Phi, whose columns ``space`` has; those of the duals are added to it. Collective.

    Args:
        model: the scene, whose layers share one damping.
        places: parameters at which the duals are to be good.
        space: residuals of Phi, at the end of a training: it cannot be extended by other modes afterwards.
        Phi: local rows (n_local, k2).

    Raises:
        SolverError: a factorisation failed, or a mode did not converge.
    """
    system, comm, C = model.system, model.system.layout.comm, model.output_columns
    extra = dual_vectors(model, places, space, Phi)
    W = np.asfortranarray(np.hstack([Phi, extra]))
    products = [[times_columns(A.ee, W) for A in (x.K_mu, x.K_lambda, x.M_1)] for x in system.layers]
    space.static.add(C)
    mine = [X[:, Phi.shape[1] :] for K_mu, K_lambda, M in products for X in (M, K_mu, K_lambda)]
    if extra.shape[1]:
        space.static.add(np.stack(mine, axis=2).reshape(len(extra), -1))
    K_mu, K_lambda, M = (np.stack([total(comm, W.T @ layer[i]) for layer in products]) for i in range(3))
    G = np.stack([total(comm, W.T @ X) for X in unit_coupling(system)[0]])
    blocks, C = comm.bcast((SecondOrder(K_mu, K_lambda, M, G), total(comm, W.T @ C)))
    return OutputDuals(blocks, C, space.static.triangle())


def corrected(
    duals: OutputDuals,
    model: ReducedModel,
    norms: ResidualNorms,
    motion: Motion,
    materials: Materials,
    drive: Drive,
    gravity: Array,
    compliance: Array,
    known: Array,
) -> tuple[Array, Array] | None:
    """Error of the outputs of a run: the part that is computed, and a bound on the rest at every step.

    Args:
        duals: of the basis of the run.
        model: of that basis.
        norms: of its residual.
        motion: the run, in its modes.
        materials: at which it was made.
        drive: under which it was made.
        gravity: likewise, (n_s,) [m/s^2].
        compliance: sqrt(c'K^-1 c) of every output or more, (p,).
        known: largest bounds on the same without duals, (p,).

    Returns:
        c'e to be added to the outputs and what may be left of it in size, (steps + 1, p) each; None where the
        frequencies without duals alone leave more than is known, or where the run is too long for the memory.
    """
    m, w = motion.modes, motion.w
    assert m is not None
    assert w is not None
    dt, steps = drive.dt, drive.steps
    if LENGTH * steps * len(w) > LARGEST:
        return None
    y = w[:, 0] / m.omega[:, None] + m.beta * w[:, 1]
    rows = np.vstack([load_rows(model, motion.v_s, dt, gravity), (y[:, 1:] + y[:, :-1]) / 2])
    still = np.concatenate([-gravity, y[:, 0]]) if drive.start == "equilibrium" else np.zeros(len(rows))
    rows -= still[:, None]
    static = norms.static_factor(materials) * _triangle(_residual(norms.columns("static", materials, 3), m))
    mass = norms.mass_factor(materials) * _triangle(_residual(norms.columns("mass", materials, 3), m))

    fade = np.cos(np.pi / 2 * np.arange(1, steps + 1) / steps) ** 2
    size = dt * float(lengths(mass @ rows).sum() + lengths(mass @ rows[:, -1:])[0] * fade.sum())
    rho, length = np.exp(-1 / steps), LENGTH * steps
    weighted = np.hstack([rows, rows[:, -1:] * fade]) * rho ** np.arange(2 * steps)
    R = np.fft.rfft(weighted, length, axis=1)
    zeta = rho * np.exp(-2j * np.pi * np.arange(R.shape[1]) / length)
    s, f = 2 / dt * (1 - zeta) / (1 + zeta), 2 * zeta / (1 + zeta)
    weight = np.full(len(s), 2.0 / length)  # the other half of the circle is conjugate
    weight[0] = weight[-1] = 1 / length
    product = abs(f) * weight * _kappa(m, s) * _norms(static, R)
    order = np.argsort(-product)
    rest_of = product.sum() - np.cumsum(product[order])
    pick = order[: min(int(np.searchsorted(-rest_of, -IGNORED * product.sum())) + 1, FREQUENCIES)]
    if (product[order[len(pick) :]].sum() * compliance > known).all():
        return None
    duals_of = _Duals(duals, model, norms, materials, m)
    part = np.zeros((len(s), len(compliance)), dtype=complex)
    left = np.outer(product, compliance)  # with d = 0
    d, rest = duals_of.at(s[pick])
    better = rest < compliance
    shown = np.einsum("wfp,wf->fp", d, duals_of.cross @ R[:, pick])
    part[pick] = np.where(better, -f[pick, None] * shown, 0.0)
    left[pick] = product[pick, None] * np.where(better, rest, compliance)
    grown = rho ** -np.arange(steps + 1.0)[:, None]
    change = np.fft.irfft(part, length, axis=0)[: steps + 1] * grown
    beyond = rho**length / (1 - rho**length) * size * compliance
    bound = grown * left.sum(axis=0) + beyond
    if still.any():
        d, rest = duals_of.at(np.zeros(1, dtype=complex))
        change -= (d[:, 0].T @ (duals_of.cross @ still)).real
        bound += rest[0] * np.linalg.norm(static @ still)
    return np.asarray(change), np.asarray(bound)


class _Duals:
    """Galerkin's duals at one parameter, in modes of W: (A(s) d = c tested by W), and what they leave of c."""

    def __init__(
        self,
        duals: OutputDuals,
        model: ReducedModel,
        norms: ResidualNorms,
        materials: Materials,
        m: Modes,
    ) -> None:
        p, factor = model.parameters(materials), norms.static_factor(materials)
        self.modes, k, count = duals.blocks.modes(p), norms.k, duals.C.shape[1]
        self.c = self.modes.X.T @ duals.C
        T, width = duals.triangle, norms.static.shape[1]
        K, M = p.stiffness(duals.blocks.K_mu, duals.blocks.K_lambda), p.density(duals.blocks.M)
        G = p.density(duals.blocks.G)
        # the residual of the run in modes of W: Phi is its first columns
        self.cross = self.modes.X.T @ _residual((G, M[:, :k], K[:, :k]), m)
        hand = norms.n_s * len(norms.reference)
        modes = [T[:, hand:width], T[:, width + count :]]  # of Phi and Psi, mode by mode
        both = np.hstack([T[:, :hand], *modes])
        _, M_T, K_T = replace(norms, static=both, mass=both).columns("static", materials, 3)
        X, omega = self.modes.X, self.modes.omega
        columns = np.hstack([T[:, width : width + count] - M_T @ (X @ self.c), K_T @ X - M_T @ (X * omega**2)])
        self.triangle = factor * _triangle(columns)

    def at(self, s: Array) -> tuple[Array, Array]:
        """Duals d in modes, (w, frequencies, p), and |c - A d|_{K^-1}, (frequencies, p), at some s."""
        stiff, m = 1 + self.modes.beta * s, self.modes
        d = self.c[:, None] / (np.outer(m.omega**2, stiff) + s**2 + m.alpha * s)[:, :, None]
        count = self.c.shape[1]
        rest = np.empty((len(s), count))
        for j in range(count):
            columns = np.r_[j, count : self.triangle.shape[1]]
            rest[:, j] = _norms(self.triangle[:, columns], np.vstack([np.ones_like(stiff), -stiff * d[:, :, j]]))
        return d, rest


def _residual(columns: tuple[Array, ...], m: Modes) -> Array:
    """Columns of a residual in modes, (G - M X g) c + (K - omega^2 M) X y, of those of c, b' and a."""
    G, M, K = columns
    return np.hstack([G - M @ (m.X @ m.g), K @ m.X - M @ (m.X * m.omega**2)])


def _norms(T: Array, x: Array) -> Array:
    """|T x| of complex columns, by real products."""
    parts = np.ascontiguousarray(x).view(float)
    squares = np.einsum("ij,ij->j", product := T @ parts, product)
    return np.asarray(np.sqrt(squares.reshape(-1, 2).sum(axis=1)))


def _triangle(columns: Array) -> Array:
    return np.asarray(scipy.linalg.qr(columns, mode="r", check_finite=False)[0][: columns.shape[1]])


def _kappa(m: Modes, s: Array) -> Array:
    """Max over omega > 0 of 1 / |a + q / omega^2|, a = 1 + beta s, q = s^2 + alpha s: the distance of a ray from 0."""
    a, q = 1 + m.beta * s, s**2 + m.alpha * s
    turned = a * np.conj(q) / np.maximum(abs(q), 1e-300)
    return np.asarray(1 / np.where(turned.real >= 0, abs(a), abs(turned.imag)))
