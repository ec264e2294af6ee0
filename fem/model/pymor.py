"""The full model for pyMOR, affine in the material of every layer; programs of one rank."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sparse

from softgrasp.fem.columns import hand_columns, labels
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.pymor import Term, operator, port, pymor_models
from softgrasp.fem.system import coupling

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model


def second_order(model: Model) -> Any:
    """Hand and tissue, x = [q_s; z], as ``pymor.models.iosys.SecondOrderModel`` M x'' + E x' + K x = B u, y = Cp x.

    M and K are sums over the layers: rho M_1, and mu K_mu + lambda K_lambda; E = alpha M_ee + beta K with damping. The
    matrices are sparse. Gravity, which only moves the state of rest, is left out.

    Raises SoftgraspError: pyMOR is not installed, the program runs on several ranks, or the tissue strains finitely.
    """
    models, system = pymor_models(), model.system
    model.scene.refuse_frame("to_pymor")
    if system.points is not None:
        raise SoftgraspError("to_pymor needs a linear model; leave out effects.finite_strain")
    n_s, n, layers, damping = system.layout.n_s, system.layout.n_e, len(system.layers), system.damping
    none = sparse.csr_matrix((n_s, n))

    def inertia(G: np.ndarray, hand: np.ndarray, M: Any) -> Any:
        return sparse.bmat([[hand, G.T if system.two_way else none], [G, M]], format="csc")

    def tissue(A: Any) -> Any:
        return sparse.block_diag([np.zeros((n_s, n_s)), A], format="csc")

    mass: list[Term] = [((), 0, inertia(np.zeros((n, n_s)), system.M_hand, sparse.csr_matrix((n, n))))]
    stiffness, loss = list[Term](), list[Term]()
    for i, layer in enumerate(system.layers):
        M_1 = to_scipy(layer.M_1.ee)
        G, rigid = coupling((layer,), (LayerMaterial(0.0, 0.0, 1.0),), system.T)
        mass.append((("rho",), i, inertia(G, rigid if system.two_way else 0 * rigid, M_1)))
        parts = [
            ((key,), i, tissue(to_scipy(part.ee))) for key, part in (("mu", layer.K_mu), ("lambda", layer.K_lambda))
        ]
        dashpot = system.materials[i].adds == "damping"
        stiffness += [] if dashpot else parts
        if damping.active:
            drag = inertia(G, rigid if system.two_way else 0 * rigid, M_1) if damping.in_space else tissue(M_1)
            loss.append((("rho",), i, damping.alpha * drag))
            loss += [(names if dashpot else ("beta", *names), i, A) for names, _, A in parts]
    C = np.zeros((sum(o.size for o in model.outputs), n_s + n))
    C[:, :n_s] = np.vstack([o.C_s for o in model.outputs])
    C[:, n_s:] = model.output_columns.T
    hand = hand_columns(n_s, system.layout.dimension)
    forces = [f"{'torque' if c.rotation else 'force'}_{c.axis} [{c.load_unit}]" for c in hand]
    columns = [c for o in model.outputs for c in o.columns]
    B = np.vstack([np.eye(n_s), np.zeros((n, n_s))])
    return models.SecondOrderModel(
        operator(mass, layers, "M"),
        operator(loss or [((), 0, sparse.csc_matrix((n_s + n, n_s + n)))], layers, "E"),
        operator(stiffness, layers, "K"),
        port(B, forces),
        port(C, [f"{label} [{c.unit}]" for label, c in zip(labels(columns), columns, strict=True)]),
        name=model.scene.name,
    )


def parameter_values(materials: tuple[LayerMaterial, ...]) -> dict[str, list[float]]:
    """Materials in the form of pyMOR's ``mu``: a list of one number a layer by parameter."""
    return {
        "mu": [m.mu for m in materials],
        "lambda": [m.lam for m in materials],
        "rho": [m.dense for m in materials],
        "beta": [m.beta for m in materials],
    }
