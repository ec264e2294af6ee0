"""Craig-Bampton: the hand's static modes and the tissue's modes clamped in the hand; no snapshots at all."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.bases.pod import PartsRequest
from softgrasp.reduction.bases.truncation import Columns, Part


def craig_bampton_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Clamped modes K_ee phi = omega^2 M_ee phi by SLEPc, used for z and for v_z: V_e = blkdiag(Phi, Phi) [CB68].

    The static modes -K_ee^-1 K_es are T, the rigid motion of the hand, because K_ee T + K_es = 0. In the
    hand-relative frame they are the hand's own unit columns and z = Phi a. Phi' M_ee Phi = I and
    Phi' K_ee Phi = diag(omega^2): V is orthonormal in the mass product. Collective.
    """
    system = request.states.system
    layout = system.layout

    def columns(k: int) -> tuple[Columns, ...]:
        Phi = lowest_modes(system, k)[1] if k else np.zeros((layout.n_local, 0))
        zero, hand = np.zeros_like(Phi), np.zeros((layout.n_s, k))
        return Columns(hand, hand, Phi, zero), Columns(hand, hand, zero, Phi)

    return (Part("clamped modes", np.zeros(0), 1.0, layout.n_e, columns),)
