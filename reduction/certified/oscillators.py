"""Second-order reduced models under a known hand, mode by mode: one small eigenproblem a parameter, then 2 x 2 steps.

With X' M X = 1 and X' K X = omega^2 of the reduced pair, a = X eta and the midpoint rule of

    eta'' + (alpha + beta omega^2) eta' + omega^2 eta = -X'G c,   c = a_s - g [+ alpha v_s]

turns w = (omega eta, eta') by one 2 x 2 matrix a mode. Blocks of steps are products; no step of Python is a time step.
Without damping that matrix is a rotation: w_1 + i w_2 turns by one angle a step, and a run is a running sum.
The same numbers as :func:`softgrasp.reduction.online.run` to rounding, in less time: nothing of size 2 k is factored.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.operators import Parameters
from softgrasp.reduction.system import ModelError

STEPS = 24  # of a block: near the root of usual numbers of steps
AT_ONCE = 32  # modes that turn together: their arrays stay in the cache


@dataclass(frozen=True)
class Modes:
    """Modes of the reduced pair at one parameter."""

    omega: Array  # (k,) [1/s]
    X: Array  # (k, k), X' M X = 1
    M: Array  # mass of the reduced pair, (k, k)
    g: Array  # X'G, (k, n_s)
    alpha: float  # mass-proportional damping [1/s]
    beta: float  # stiffness-proportional damping [s]

    @property
    def inverse(self) -> Array:
        """X^-1 = X' M."""
        return self.X.T @ self.M

    @property
    def rate(self) -> Array:
        """Damping alpha + beta omega^2 of every mode."""
        return np.asarray(self.alpha + self.beta * self.omega**2)


@dataclass(frozen=True)
class SecondOrder:
    """Reduced matrices of every layer at unit materials: a whole second-order model."""

    K_mu: Array  # stiffness at mu = 1 Pa, lambda = 0, (L, k, k)
    K_lambda: Array  # stiffness at lambda = 1 Pa, mu = 0, (L, k, k)
    M: Array  # mass at rho = 1 kg/m^3, (L, k, k)
    G: Array  # coupling to the hand at rho = 1 kg/m^3, (L, k, n_s)
    # of the last densities: these, the mass M = L L', L^-1, and both stiffnesses of every layer as L^-1 K L^-T
    kept: list[tuple[tuple[float, ...], Array, Array, Array, Array]] = field(
        default_factory=list, init=False, repr=False, compare=False
    )

    @staticmethod
    def of(model: ReducedModel) -> SecondOrder:
        """Blocks of a model with V = blkdiag(I, Phi, Phi)."""
        hand = 2 * len(model.parts["M_hand"])
        q, v = slice(hand, (hand + model.N) // 2), slice((hand + model.N) // 2, model.N)
        K_mu, K_lambda, M = (
            np.array(model.parts[key][:, v, columns]) for key, columns in (("K_mu", q), ("K_lambda", q), ("M", v))
        )
        return SecondOrder(K_mu, K_lambda, M, np.array(model.parts["WG"][:, v]))

    def modes(self, p: Parameters) -> Modes:
        """Solve K x = omega^2 M x at a parameter.

        Raises:
            ModelError: the reduced mass is not definite, as with linearly dependent columns.
        """
        try:
            M, inverse, K_mu, K_lambda = self._in_mass(p)
            squares, Y = np.linalg.eigh(p.stiffness(K_mu, K_lambda))
        except np.linalg.LinAlgError as error:
            raise ModelError("the reduced mass is singular; its basis vectors are linearly dependent") from error
        X, omega = inverse.T @ Y, np.sqrt(np.maximum(squares, 0.0))
        return Modes(omega, X, M, X.T @ p.density(self.G), p.alpha if p.damped else 0.0, p.materials[0].beta)

    def _in_mass(self, p: Parameters) -> tuple[Array, Array, Array, Array]:
        """M, L^-1 and the stiffnesses in columns orthonormal in M, made once for parameters of the same densities."""
        densities = tuple(m.dense for m in p.materials)
        kept = next(iter(self.kept), None)
        if kept is None or kept[0] != densities:
            M = p.density(self.M)
            inverse = scipy.linalg.solve_triangular(np.linalg.cholesky(M), np.eye(len(M)), lower=True)
            K_mu, K_lambda = (inverse @ K @ inverse.T for K in (self.K_mu, self.K_lambda))
            kept = densities, M, inverse, K_mu, K_lambda
            self.kept[:] = [kept]
        return kept[1:]


def march(omega: Array, rate: Array, loads: Array, dt: float, start: Array | None = None) -> Array:
    """Midpoint steps of eta'' + rate eta' + omega^2 eta = f for many modes; w = (omega eta, eta').

    Args:
        omega: angular frequency of every mode, (m,) [1/s].
        rate: damping of every mode, (m,) [1/s].
        loads: f at the midpoints of the steps, (m, steps).
        dt: step [s].
        start: w at the start, (m, 2); None is zero.

    Returns:
        w, (m, 2, steps + 1).
    """
    if not rate.any():
        return _turned(omega, loads, dt, start)
    (m, steps), h = loads.shape, dt / 2
    b = min(STEPS, steps)
    blocks = -(-steps // b)
    inverse = np.empty((m, 2, 2))  # (1 - h A)^-1 with A = [0, omega; -omega, -rate]
    inverse[:, 0, 0], inverse[:, 1, 1] = 1 + h * rate, 1.0
    inverse[:, 0, 1], inverse[:, 1, 0] = h * omega, -h * omega
    inverse /= (1 + h * rate + (h * omega) ** 2)[:, None, None]
    powers = np.empty((m, b + 1, 2, 2))
    powers[:, 0], powers[:, 1] = np.eye(2), 2 * inverse - np.eye(2)
    done = 1
    while done < b:
        more = min(done, b - done)
        powers[:, done + 1 : done + 1 + more] = powers[:, done : done + 1] @ powers[:, 1 : 1 + more]
        done += more
    impulse = np.zeros((m, b + 1, 2))  # answer to a unit load in one step; the last row stays 0
    impulse[:, :b] = (powers[:, :b] @ (dt * inverse[:, None, :, 1:]))[..., 0]
    lag = np.subtract.outer(np.arange(b), np.arange(b))
    answer = np.empty((m, b, 2, b + 2))  # of a block's states to its loads and its start
    answer[..., :b] = impulse[:, np.where(lag >= 0, lag, b)].transpose(0, 1, 3, 2)
    answer[..., b:] = powers[:, 1:]
    answer = answer.reshape(m, 2 * b, b + 2)
    inputs = np.zeros((m, b + 2, blocks))
    padded = np.zeros((m, blocks * b))
    padded[:, :steps] = loads
    inputs[:, :b] = padded.reshape(m, blocks, b).transpose(0, 2, 1)
    ends = answer[:, -2:, :b] @ inputs[:, :b]  # what the loads of each block leave at its end
    turn, w = powers[:, b], np.zeros((m, 2)) if start is None else start
    inputs[:, b:, 0] = w
    for i in range(blocks - 1):
        w = (turn @ w[:, :, None])[:, :, 0] + ends[:, :, i]
        inputs[:, b:, i + 1] = w
    states = np.empty((m, 2, steps + 1))
    states[:, :, 0] = inputs[:, b:, 0]
    moved = (answer @ inputs).reshape(m, b, 2, blocks).transpose(0, 2, 3, 1).reshape(m, 2, blocks * b)
    states[:, :, 1:] = moved[:, :, :steps]
    return states


def _turned(omega: Array, loads: Array, dt: float, start: Array | None) -> Array:
    """The same without damping: z_n = r^n (z_0 + q sum over j < n of r^(-j-1) f_j), z = w_1 + i w_2, |r| = 1.

    It is z_{n+1} = r z_n + q f_n with r = (1 - i h omega) / (1 + i h omega), q = i dt / (1 + i h omega), h = dt / 2.
    """
    (m, steps), h = loads.shape, dt / 2
    states = np.empty((m, 2, steps + 1))
    states[:, :, 0] = 0.0 if start is None else start
    blocks = -(-(steps + 1) // STEPS)
    angle = -2 * np.arctan(h * omega)
    near, far = (_unit(np.multiply.outer(angle, n)) for n in (np.arange(STEPS), STEPS * np.arange(blocks)))
    gain = 1j * dt / (1 + 1j * h * omega)
    powers = np.empty((AT_ONCE, blocks, STEPS), dtype=complex)
    for first in range(0, m, AT_ONCE):
        part = slice(first, min(first + AT_ONCE, m))
        count = part.stop - first
        turn = np.multiply(far[part, :, None], near[part, None], out=powers[:count]).reshape(count, -1)[:, :steps]
        z = turn.conj()
        z *= loads[part]
        np.cumsum(z, axis=1, out=z)
        z *= gain[part, None]
        if start is not None:  # a step on, since the powers begin with 1
            z += (near[part, 1] * (start[part, 0] + 1j * start[part, 1]))[:, None]
        z *= turn
        states[part, 0, 1:], states[part, 1, 1:] = z.real, z.imag
    return states


def _unit(angle: Array) -> Array:
    """exp(i angle), by cosine and sine, which are several times as fast as the complex exponential."""
    result = np.empty(angle.shape, dtype=complex)
    result.real, result.imag = np.cos(angle), np.sin(angle)
    return result
