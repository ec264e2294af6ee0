"""Dense Riccati equations: ordered Schur form of the scaled Hamiltonian matrix, polished by Newton's method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, Complex
from softgrasp.fem.reduced import StateSpace
from softgrasp.lqr.plant.checks import EPS, ControlError, check_finite, check_weights, square_root

NEWTON_STEPS = 6  # two are enough after a Schur form; more means that nothing is gained any more
PBH_LIMIT = 12  # eigenvalues that are examined one by one, each by an SVD of order n
FAST_RESIDUAL = 1e-9  # relative to C'QC; the structured plant in energy scaling reaches 1e-13
FAST_BACKWARD = 1e-12  # relative to all four terms, where P is so large that C'QC drowns in their rounding
# Distance of a Hamiltonian matrix to a singular one, over its norm, that is the rounding of a projection: the paper's
# bases with too few columns show 1e-20 to 8e-14, all others 4e-10 or more.
UNSEEN = 1e4 * EPS


@dataclass(frozen=True, repr=False)
class WeightedSystem(StateSpace):
    """E x' = A x + B u, y = C x with the weights of the cost, the integral of y'Qy + u'Ru."""

    Q: Array  # weight of the outputs, (p, p)
    R: Array  # weight of the inputs, (m, m)


@dataclass(frozen=True)
class DenseSolution:
    """X of A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 with its gain, poles and errors."""

    X: Array  # stabilising solution, symmetric, (n, n)
    K: Array  # feedback u = K x, -R^{-1} B'XE, (m, n)
    poles: Complex  # eigenvalues of E^{-1}(A + B K), (n,)
    residual: float  # ||Res||_F / ||C'QC||_F
    backward: float  # backward error: ||Res||_F over the sum of the norms of the four terms
    newton_steps: int  # accepted Newton steps after the Schur form

    @property
    def abscissa(self) -> float:
        """Largest real part of the closed loop [1/s]."""
        return float(self.poles.real.max())


def care(A: Array, B: Array, C: Array, Q: Array, R: Array, E: Array | None = None) -> DenseSolution:
    """Solve A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 for the stabilising X, for small n.

    Ordered real Schur form of the balanced Hamiltonian matrix [L79], then Newton's method [K68] on the residual. The
    work is 25 (2n)^3 operations; memory some 20 n^2. Inputs are not changed.

    Args:
        A, E: (n, n), E regular; None: I.
        B, C: (n, m) and (p, n).
        Q, R: (p, p), symmetric positive semidefinite, and (m, m), symmetric positive definite.

    Raises:
        ControlError: data that are no numbers, an indefinite weight, (E, A, B) not stabilisable, (E, A, C) not
            detectable, or a closed-loop eigenvalue on the imaginary axis.
    """
    check_finite(A=A, B=B, C=C, E=E)
    check_weights(Q, R, C.shape[0], B.shape[1])
    if E is not None:
        lu, pivots, rcond = reciprocal_condition(E)
        if not rcond > EPS:
            raise ControlError(f"E is singular to working precision (reciprocal condition {rcond:.1e})")
        solve = (lu, pivots)
        A, B = scipy.linalg.lu_solve(solve, A), scipy.linalg.lu_solve(solve, B)
    root = square_root(Q) @ C
    H = root.T @ root
    lower = np.linalg.cholesky(R)
    B_1 = scipy.linalg.solve_triangular(lower, B.T, lower=True).T  # B R^{-1/2}
    G = B_1 @ B_1.T
    try:
        Y, poles, steps = riccati_schur(A, G, H)
    except ControlError as error:
        raise ControlError(_explain(A, B_1, root) or str(error)) from error
    if hidden := unreached(A.T, root.T):
        raise ControlError(_unseen(hidden))
    K = -scipy.linalg.cho_solve((lower, True), B.T @ Y)
    residual, parts = _residual(A, G, H, Y)
    size = float(np.linalg.norm(residual))
    if E is not None:  # Y = E'XE
        half = scipy.linalg.lu_solve(solve, Y, trans=1)
        Y = scipy.linalg.lu_solve(solve, half.T, trans=1)
        Y = (Y + Y.T) / 2
    relative = size / (float(np.linalg.norm(H)) or 1.0)
    return DenseSolution(Y, K, poles, relative, size / (parts or 1.0), steps)


def care_of(space: WeightedSystem) -> DenseSolution:
    """See :func:`care`. Raises ControlError: there is no stabilising solution."""
    return care(space.A, space.B, space.C, space.Q, space.R, space.E)


def riccati_residual(A: Array, G: Array, H: Array, X: Array) -> Array:
    """Return A'X + XA - XGX + H."""
    return _residual(A, G, H, X)[0]


def _residual(A: Array, G: Array, H: Array, X: Array) -> tuple[Array, float]:
    """The residual and the sum of the norms of its terms."""
    product, square = A.T @ X, X @ G @ X
    size = 2 * float(np.linalg.norm(product)) + float(np.linalg.norm(square)) + float(np.linalg.norm(H))
    return np.asarray(product + product.T - square + H), size


def reciprocal_condition(M: Array) -> tuple[Array, Array, float]:
    """LU factors and pivots of M with an estimate of 1 / (|M|_1 |M^{-1}|_1)."""
    lu, pivots, info = scipy.linalg.lapack.dgetrf(M)
    size = float(np.abs(M).sum(axis=0).max(initial=0.0))
    rcond = 0.0 if info > 0 else float(scipy.linalg.lapack.dgecon(lu, size, norm="1")[0])
    return lu, pivots, rcond


def riccati_schur(A: Array, G: Array, H: Array) -> tuple[Array, Complex, int]:
    """Solve A'X + XA - XGX + H = 0 for symmetric G and H; also return the poles of A - GX and the Newton steps.

    H may be indefinite as long as a stabilising solution exists.

    Raises:
        ControlError: an eigenvalue of the Hamiltonian matrix lies on the imaginary axis, or the stable invariant
            subspace gives no X.
    """
    hamiltonian, scale, weight = balanced_hamiltonian(A, G, H)
    n = len(A)
    try:
        T, U, stable = scipy.linalg.schur(hamiltonian, output="real", sort="lhp")
    except np.linalg.LinAlgError as error:  # eigenvalues that rounding moves over the axis while they are sorted
        raise ControlError(
            f"the stable eigenvalues of the Hamiltonian matrix cannot be separated from the others ({error}): Q and R "
            "are too far apart, or some mode is hardly damped"
        ) from error
    values = block_eigenvalues(T)
    check_axis(hamiltonian, values, stable)
    top, bottom = U[:n, :n], U[n:, :n]
    lu, pivots, rcond = reciprocal_condition(top.T)
    if not rcond > EPS:
        raise ControlError(
            f"the stable subspace of the Hamiltonian matrix gives no solution (reciprocal condition {rcond:.1e}): "
            "(A, B) is not stabilisable; an input has to reach every mode that does not decay by itself"
        )
    X = scipy.linalg.lu_solve((lu, pivots), bottom.T).T
    X = (X + X.T) / 2 * weight / scale[:, None] / scale
    X, poles, steps = newton_polish(A, G, H, X)
    abscissa = float(poles.real.max())
    if not abscissa < 0:
        raise ControlError(
            f"the closed loop computed has the abscissa {abscissa:.1e}, not below 0: the problem is on the edge of "
            "what double precision can stabilise; add damping or rescale"
        )
    return X, poles, steps


def balanced_hamiltonian(A: Array, G: Array, H: Array) -> tuple[Array, Array, float]:
    """[a, -g; -h, -a'], a = D^{-1}AD, g = c D^{-1}GD^{-1}, h = DHD/c with rows of like size, d (powers of 2) and c.

    The Hamiltonian matrix keeps its structure because x is scaled by D and the costate by D^{-1}/c [B01].
    """
    n = len(A)
    size = np.block([[np.abs(A), np.abs(G)], [np.abs(H), np.abs(A.T)]])
    np.fill_diagonal(size, 0.0)
    _, (factors, _) = scipy.linalg.matrix_balance(size, separate=True, permute=False)
    exponent = np.log2(factors)
    scale = np.exp2(np.round((exponent[:n] - exponent[n:]) / 2))
    g = float(np.linalg.norm(G / scale[:, None] / scale))
    h = float(np.linalg.norm(H * scale[:, None] * scale))
    weight = float(np.exp2(np.round(np.log2(h / g) / 2))) if g > 0 and h > 0 else 1.0
    a, G, H = A / scale[:, None] * scale, G / scale[:, None] / scale * weight, H * scale[:, None] * scale / weight
    return np.block([[a, -G], [-H, -a.T]]), scale, weight


def block_eigenvalues(T: Array) -> Complex:
    """Eigenvalues of a standardised real Schur form, in its order."""
    n = len(T)
    real, imag = np.diag(T).copy(), np.zeros(n)
    below = np.diag(T, -1)
    at = np.flatnonzero(below)
    # LAPACK standardises 2 x 2 blocks to equal diagonals and off-diagonals of opposite sign
    imag[at] = np.sqrt(np.abs(below[at])) * np.sqrt(np.abs(T[at, at + 1]))
    imag[at + 1] = -imag[at]
    return np.asarray(real + 1j * imag)


def check_axis(hamiltonian: Array, values: Complex, stable: int) -> None:
    """No eigenvalue of the Hamiltonian matrix is on the imaginary axis to working precision.

    A double eigenvalue on the axis splits by sqrt(eps), so a small real part alone proves nothing: what counts is the
    distance min sigma(H - i omega I) to a matrix with an eigenvalue there.

    Raises ControlError: the distance is of the order of rounding.
    """
    n = len(hamiltonian) // 2
    size = float(np.linalg.norm(hamiltonian))
    nearest = int(np.argmin(np.abs(values.real)))
    real, omega = float(values.real[nearest]), abs(float(values.imag[nearest]))
    near = abs(real) < 10 * np.sqrt(EPS) * size
    near = near and smallest_singular_value(hamiltonian, 1j * omega) <= 10 * EPS * size
    if stable != n or near:
        raise ControlError(
            f"the Hamiltonian matrix has the eigenvalue {real:.1e} + {omega:.3g}i, on the imaginary axis to working "
            "precision: some mode is neither damped by itself nor reached by the inputs and seen by the outputs"
        )


def smallest_singular_value(M: Array, shift: complex) -> float:
    """Estimate sigma_min(M - shift I) by inverse iteration on one LU factorisation."""
    n = len(M)
    shifted = np.asarray(M - shift * np.eye(n), dtype=complex)
    factors, pivots, info = scipy.linalg.lapack.zgetrf(shifted)
    if info > 0:
        return 0.0
    x = np.cos(1.0 + np.arange(n)) + 1j * np.sin(2.0 + 3.0 * np.arange(n))
    sigma = np.inf
    for _ in range(6):
        x = x / np.linalg.norm(x)
        x = scipy.linalg.lu_solve((factors, pivots), x)
        x = scipy.linalg.lu_solve((factors, pivots), x, trans=2)
        sigma = min(sigma, 1.0 / np.sqrt(np.linalg.norm(x)))
    return float(sigma)


def newton_polish(A: Array, G: Array, H: Array, X: Array) -> tuple[Array, Complex, int]:
    """Newton's method in correction form, (A - GX)'N + N(A - GX) = -Res, X <- X + N, while the residual halves.

    Returns X, the eigenvalues of A - GX and the number of accepted steps.
    """
    residual = riccati_residual(A, G, H, X)
    size = float(np.linalg.norm(residual))
    accepted = 0
    T, U = scipy.linalg.schur(A - G @ X, output="real")
    for _ in range(NEWTON_STEPS):
        if size == 0 or not float(block_eigenvalues(T).real.max()) < 0:
            break
        trial = X + lyapunov(T, U, residual)
        new = riccati_residual(A, G, H, trial)
        smaller = float(np.linalg.norm(new))
        if not smaller < size / 2:
            break
        X, residual, size = trial, new, smaller
        accepted += 1
        T, U = scipy.linalg.schur(A - G @ X, output="real")
    return X, block_eigenvalues(T), accepted


def lyapunov(T: Array, U: Array, W: Array) -> Array:
    """Solve F'N + N F = -W for F = U T U', T in real Schur form, W symmetric."""
    (trsyl,) = scipy.linalg.get_lapack_funcs(("trsyl",), (T,))
    N, factor, info = trsyl(T, T, -(U.T @ W @ U), trana="T", tranb="N")
    if info < 0:
        raise ControlError(f"the Lyapunov equation of order {len(T)} was refused by LAPACK (info {info})")
    N = U @ (N * (1.0 / factor if factor else np.inf)) @ U.T
    return np.asarray((N + N.T) / 2)


def unreached(A: Array, B: Array) -> list[complex]:
    """Eigenvalues of A with Re >= 0 to rounding that no input reaches: rank [A - s I, B] < n [H69].

    For outputs that do not see call it with A', C'. The :data:`PBH_LIMIT` eigenvalues farthest to the right are
    examined.
    """
    n = len(A)
    values = scipy.linalg.eigvals(A)
    size = float(np.linalg.norm(A))
    candidates = values[values.real >= -100 * EPS * size]
    candidates = candidates[candidates.imag >= 0]
    candidates = candidates[np.argsort(-candidates.real)][:PBH_LIMIT]
    scaled = B * ((size or 1.0) / (float(np.linalg.norm(B)) or 1.0))
    poles: list[complex] = []
    seen: list[complex] = []
    for s in candidates:
        if any(abs(s - t) <= np.sqrt(EPS) * size for t in seen):  # a multiple eigenvalue splits by rounding
            continue
        seen.append(complex(s))
        pencil = np.hstack([A - (s if s.imag else s.real) * np.eye(n), scaled])
        if scipy.linalg.svdvals(pencil)[-1] <= 10 * n * EPS * size:
            poles.append(complex(s))
    return poles


def _explain(A: Array, B: Array, C: Array) -> str | None:
    """The reason, when one of the two rank tests finds it."""
    missed = unreached(A, B)
    if missed:
        return (
            f"not stabilisable: no input reaches the mode with eigenvalue {missed[0]:.3g}, which does not decay by "
            "itself; add an input there or damping"
        )
    hidden = unreached(A.T, C.T)
    return _unseen(hidden) if hidden else None


def _unseen(hidden: list[complex]) -> str:
    return (
        f"not detectable: no weighted output sees the mode with eigenvalue {hidden[0]:.3g}, which does not decay by "
        "itself; add an output that sees it, give it a positive weight, or add damping"
    )


def solve_reduced(space: WeightedSystem) -> Array:
    """P of E'PA + A'PE - E'PB R^{-1} B'PE + C'QC = 0, (N, N), in well below a millisecond for a small N.

    The Hamiltonian matrix, scaled by one number so that its off-diagonal blocks have like size, is brought to ordered
    real Schur form. When the residual shows that this is not good enough, :func:`care` balances, polishes and explains.
    Raises ControlError: there is no stabilising solution.
    """
    P = fast_solution(space)
    return care_of(space).X if P is None else P


def fast_solution(m: WeightedSystem) -> Array | None:
    """P without balancing, or None when it is not accurate or not stabilising.

    Raises ControlError: see :func:`check_seen`.
    """
    n = m.N
    lu, pivots, info = scipy.linalg.lapack.dgetrf(m.E)
    if info:
        return None
    solved, _ = scipy.linalg.lapack.dgetrs(lu, pivots, np.hstack([m.A, m.B]))
    A, B = solved[:, :n], solved[:, n:]
    G = B @ np.linalg.solve(m.R, B.T)
    H = m.C.T @ m.Q @ m.C
    g, h = np.linalg.norm(G), np.linalg.norm(H)
    if not (g > 0 and h > 0 and np.isfinite(g) and np.isfinite(h)):
        return None
    c = np.sqrt(h / g)
    hamiltonian = np.empty((2 * n, 2 * n), order="F")
    hamiltonian[:n, :n], hamiltonian[:n, n:] = A, -c * G
    hamiltonian[n:, :n], hamiltonian[n:, n:] = H / -c, -A.T
    _, stable, real, imag, U, _, info = scipy.linalg.lapack.dgees(
        lambda x, _: x < 0, hamiltonian, sort_t=1, overwrite_a=1
    )
    if info or stable != n or not real[:n].max() < -1e-10 * np.abs(real).max():
        return None
    if real[:n].max() > -(EPS**0.25) * np.hypot(real, imag).max():
        check_seen(A, G, H, float(imag[np.argmax(real[:n])]))
    lu_1, pivots_1, info = scipy.linalg.lapack.dgetrf(U[:n, :n].T)
    if info:
        return None
    Y = c * scipy.linalg.lapack.dgetrs(lu_1, pivots_1, U[n:, :n].T)[0].T
    Y = (Y + Y.T) / 2
    R, parts = _residual(A, G, H, Y)
    if not np.linalg.norm(R) <= FAST_RESIDUAL * h:  # P is large: one Newton step
        T, W = scipy.linalg.schur(A - G @ Y, output="real", check_finite=False)
        Y = Y + lyapunov(T, W, R)
        R, parts = _residual(A, G, H, Y)
        if not np.linalg.norm(R) <= FAST_BACKWARD * parts:
            return None
    half, _ = scipy.linalg.lapack.dgetrs(lu, pivots, Y, trans=1)
    P, _ = scipy.linalg.lapack.dgetrs(lu, pivots, half.T, trans=1)
    return np.asarray((P + P.T) / 2)


def check_seen(A: Array, G: Array, H: Array, omega: float) -> None:
    """The Hamiltonian matrix is farther from one with the eigenvalue i omega than a projection rounds.

    A rigid motion that inputs do not reach or outputs do not see makes a quadruple eigenvalue 0, which rounding moves
    by eps^(1/4): a solution exists then, but another one on another number of ranks. Raises ControlError: it is not.
    """
    hamiltonian, _, _ = balanced_hamiltonian(A, G, H)
    if smallest_singular_value(hamiltonian, 1j * omega) <= UNSEEN * float(np.linalg.norm(hamiltonian)):
        raise ControlError(
            f"the reduced equation of order {len(A)} has a solution by rounding alone: a mode that does not decay by "
            "itself is not reached by the inputs or not seen by the outputs; use another order N"
        )
