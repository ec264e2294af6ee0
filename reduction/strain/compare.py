"""How far runs of reduced models at finite strain are from a full run: |z - Phi a|, velocities, and the energy norm.

Everything comes from small products with the snapshots, made once for a basis and all that begin it:
|Z - Phi A|_W^2 = |Z|_W^2 - 2 (Phi'W Z) : A + A : (Phi'W Phi) A, W = I, K_ee or M_ee. Rounding leaves 1e-8 of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array, PETSc, times_columns, total
from softgrasp.reduction.errors import column_blocks, ratio
from softgrasp.reduction.model import ModelError
from softgrasp.reduction.replay import FullRun


@dataclass(frozen=True)
class StrainErrors:
    """Relative errors over the snapshots of one full run, or of several, dimensionless."""

    z: float  # |Z - Phi A|_F / |Z|_F of the deformation
    v: float  # |V - Phi A'|_M / |V|_M of its velocity
    energy_norm: float  # of (z, v) in (z' K_ee z + v' M_ee v)^(1/2), K_ee at rest


@dataclass(frozen=True)
class Products:
    """Phi'W Phi (k, k), Phi'W X (k, m) and |X|_W^2 of snapshots X in one product W."""

    gram: Array
    cross: Array
    square: float

    def missed(self, a: Array) -> float:
        """|X - Phi A'|_W^2 of coordinates (m, k), of the leading ones alone where they are fewer."""
        k = a.shape[1]
        return self.square + float(np.sum(a * (a @ self.gram[:k, :k] - 2 * self.cross[:k].T)))


@dataclass(frozen=True)
class Reference:
    """A full run in terms of a basis."""

    full: FullRun  # the run
    flat: Products  # flat, stiff: z in the products I and K_ee
    stiff: Products
    mass: Products  # v in M_ee, so that its ``gram`` is I
    a: Array  # Phi' M Z, the coordinates of every snapshot, (m, k)

    def missed(self, a: Array, v: Array) -> Array:
        """[missed, whole] squares of z, v and the energy norm for states (steps + 1, k), (3, 2).

        Raises ModelError: the run is shorter than the snapshots.
        """
        steps = self.full.snapshots.steps
        if len(a) <= int(steps.max(initial=0)):
            raise ModelError(f"the reduced run has {len(a) - 1} steps, the snapshots reach step {int(steps.max())}")
        z, stiff, mass = self.flat, self.stiff, self.mass
        v_missed = mass.missed(v[steps])
        return np.array(
            [
                (z.missed(a[steps]), z.square),
                (v_missed, mass.square),
                (stiff.missed(a[steps]) + v_missed, stiff.square + mass.square),
            ]
        )

    def errors(self, a: Array, v: Array) -> StrainErrors:
        """Errors of one run."""
        return errors_of([self.missed(a, v)])

    def projection_error(self, k: int) -> float:
        """min_A |Z - Phi A|_F / |Z|_F over the first k columns."""
        cross = self.flat.cross[:k]
        best = np.linalg.solve(self.flat.gram[:k, :k], cross)
        return ratio(max(self.flat.square - float(np.sum(cross * best)), 0.0), self.flat.square)


def errors_of(missed: list[Array]) -> StrainErrors:
    """Errors over several runs together, from what :meth:`Reference.missed` gives of each."""
    sums = np.sum(missed, axis=0)
    return StrainErrors(*(ratio(max(float(part), 0.0), float(whole)) for part, whole in sums))


def reference_of(full: FullRun, Phi: Array) -> Reference:
    """Products of the snapshots with local rows Phi (n_local, k). Collective."""
    system, n = full.model.system, full.model.system.layout.n_local
    Z, V = full.snapshots.Z[:n], full.snapshots.Z[n:]
    comm = system.layout.comm
    M_Phi = times_columns(system.M_ee, Phi)

    def products(W_Phi: Array, W: PETSc.Mat, X: Array) -> Products:
        square = sum(float(np.vdot(X[:, b], times_columns(W, X[:, b]))) for b in column_blocks(X.shape[1]))
        return Products(total(comm, Phi.T @ W_Phi), total(comm, W_Phi.T @ X), float(comm.allreduce(square)))

    eye = Products(total(comm, Phi.T @ Phi), total(comm, Phi.T @ Z), float(comm.allreduce(float(np.vdot(Z, Z)))))
    stiff = products(times_columns(system.K_ee, Phi), system.K_ee, Z)
    return Reference(full, eye, stiff, products(M_Phi, system.M_ee, V), total(comm, M_Phi.T @ Z).T)
