"""The coupled block system in the hand's frame, and the paper's blocks it comes from.

With the displacement relative to the rigid motion of the hand, z = q_e - T q_s, the stiffness acts on z alone because
K_ee T + K_es = 0, and the only coupling is the inertia G = M_es + M_ee T:

    M_ee z'' + D_ee z' + K_ee z = -G (a_s - g) [- alpha G v_s]      tissue
    M_ss a_s [+ G' z'' + M_rigid (a_s - g)] = u                     hand ([...] two-way only)
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.material import LayerMaterial, differs, of_layers
from softgrasp.fem.petsc import Array, PETSc, combine, rows_on_all, times_columns, total, whole_copy
from softgrasp.fem.shown import Shown

if TYPE_CHECKING:  # only scenes with finite strain, an own energy or the frame of a turning hand load them
    from softgrasp.fem.energy.layers import LayerEnergy
    from softgrasp.fem.frame.integrals import FrameIntegrals
    from softgrasp.fem.strain.points import QuadraturePoints


@dataclass(frozen=True)
class Component:
    """One affine component A of the finite element matrix, in the blocks of hand and tissue."""

    ee: PETSc.Mat  # A on the free nodes, distributed (n_e, n_e)
    es: Array  # A R on the free nodes, local rows (n_local, n_s)
    ss: Array  # R' A R, (n_s, n_s), the same on every rank


@dataclass(frozen=True)
class LayerBlocks:
    """Affine components of one layer: K = mu K_mu + lambda K_lambda, M = rho M_1."""

    name: str  # name of the layer
    K_mu: Component  # stiffness at mu = 1, lambda = 0 [m^(d-2), in 2D times the thickness]
    K_lambda: Component  # stiffness at mu = 0, lambda = 1, in the same unit
    M_1: Component  # mass at rho = 1 [m^d, in 2D times the thickness]
    load: tuple[Array, Array] | None = None  # own load at value 1: free rows (n_local,), and hand (n_s,) [N, N m]
    definite: bool = True  # whether the form of an own term is positive semidefinite


@dataclass(frozen=True)
class Damping:
    """D = alpha M + beta K on the tissue."""

    alpha: float = 0.0  # mass-proportional rate [1/s]
    beta: float = 0.0  # stiffness-proportional time [s]
    in_space: bool = False  # whether alpha drags the rigid motion too
    matrix: PETSc.Mat | None = None  # D in place of beta K where layers differ in beta [N s/m], (n_e, n_e); else None

    @property
    def active(self) -> bool:
        """Whether any damping acts."""
        return self.alpha > 0 or self.beta > 0 or self.matrix is not None

    @property
    def drag(self) -> float:
        """The part of alpha that drags the rigid motion [1/s]."""
        return self.alpha if self.in_space else 0.0


@dataclass(frozen=True, repr=False)
class BlockSystem(Shown):
    """All operators of one scene, in z = q_e - T q_s, the displacement relative to the hand [SBRH21].

    K_ee = sum over layers of mu K_mu + lambda K_lambda, M_ee = sum of rho M_1; the equations are at the top of this
    module. Matrices are distributed over ``layout.comm``, small arrays are the same on every rank.
    """

    layout: BlockLayout  # sizes and ownership of the unknowns
    layers: tuple[LayerBlocks, ...]  # affine components of each layer
    materials: tuple[LayerMaterial, ...]  # material of each layer
    M_ee: PETSc.Mat  # tissue mass [kg], (n_e, n_e), symmetric positive definite
    K_ee: PETSc.Mat  # tissue stiffness [N/m], (n_e, n_e), symmetric positive definite
    T: Array  # rigid modes of the hand at the free nodes, local rows (n_local, n_s) [1, m]
    G: Array  # M_es + M_ee T, local rows (n_local, n_s) [kg, kg m]
    M_hand: Array  # hand mass matrix, (n_s, n_s) [kg, kg m^2]
    M_rigid: Array  # inertia of the tissue moved rigidly with the hand, (n_s, n_s) [kg, kg m, kg m^2]
    damping: Damping  # damping of the tissue
    gravity: Array | None = None  # free fall in the hand's degrees of freedom, (n_s,) [m/s^2], or None
    hand_weight: bool = False  # whether gravity acts on the hand's own mass too
    two_way: bool = False  # whether the tissue acts on the hand
    memory: float = np.inf  # that a solver may need to be chosen [byte]
    graded: bool = False  # whether cell sizes vary so much that Euclidean norms of node values mean little
    points: QuadraturePoints | None = None  # quadrature points of the finite-strain law; None: linear, force K_ee z
    energy: LayerEnergy | None = None  # own energy of the tissue; None: a built-in law
    frame: FrameIntegrals | None = None  # integrals of a hand that turns by any angle; None: equations of small angles
    # factor and modes of K_ee, made on the first request (softgrasp.fem.solve.stiffness, softgrasp.fem.solve.modes)
    kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def contrast(self) -> float:
        """Largest lambda / mu of the materials [1]: 49 at nu = 0.49."""
        return max(m.lam / m.mu for m in of_layers(self.materials))

    @property
    def fall(self) -> Array:
        """Free fall in the hand's degrees of freedom, zero without gravity, (n_s,) [m/s^2]."""
        return np.zeros(self.layout.n_s) if self.gravity is None else self.gravity

    @property
    def own_load(self) -> Array | None:
        """Load of own terms on the free nodes, local rows (n_local,) [N]; None without such terms."""
        rows = [(m.pulls, x.load[0]) for x, m in zip(self.layers, self.materials, strict=True) if x.load is not None]
        return sum_dense(rows) if rows else None

    @property
    def own_wrench(self) -> Array:
        """The same on hand and tissue as they move rigidly, (n_s,) [N, N m]."""
        rows = [(m.pulls, x.load[1]) for x, m in zip(self.layers, self.materials, strict=True) if x.load is not None]
        return sum_dense(rows) if rows else np.zeros(self.layout.n_s)

    @property
    def static_load(self) -> Array | None:
        """Weight and own loads on the free nodes, G g + f, local rows (n_local,) [N]; None where there is neither."""
        own, weight = self.own_load, None if self.gravity is None else self.G @ self.gravity
        if own is None or weight is None:
            return weight if own is None else own
        return np.asarray(weight + own)

    @property
    def springs(self) -> PETSc.Mat | None:
        """Stiffness of own terms, which finite strain adds to its law; None without such terms. Collective."""
        rows = [(m.mu, x.K_mu.ee) for x, m in zip(self.layers, self.materials, strict=True) if m.adds == "stiffness"]
        return combine(rows) if rows else None

    @property
    def weight(self) -> Array:
        """Weight of the hand, zero unless gravity acts on it, (n_s,) [N, N m]."""
        return self.M_hand @ self.fall if self.hand_weight else np.zeros(self.layout.n_s)

    @property
    def M_es(self) -> Array:
        """The paper's M_es, local rows (n_local, n_s)."""
        return sum_dense([(m.dense, layer.M_1.es) for layer, m in zip(self.layers, self.materials, strict=True)])

    @property
    def K_es(self) -> Array:
        """The paper's K_es, local rows (n_local, n_s)."""
        return sum_dense(_stiffness(self.layers, self.materials, "es"))

    def release(self) -> None:
        """Free the matrices of the affine components, three of the seven of a step, where no more are made. Collective.

        The system steps as before; :meth:`with_materials`, reductions and bounds need what is gone. Own springs at
        finite strain stay, whose steps use them.
        """
        for layer, m in zip(self.layers, self.materials, strict=True):
            if self.points is None or m.adds != "stiffness":
                for component in (layer.K_mu, layer.K_lambda, layer.M_1):
                    component.ee.destroy()

    def with_materials(self, materials: tuple[LayerMaterial, ...]) -> BlockSystem:
        """The same scene with other lambda, mu, rho, beta: a few axpy, no assembly. Collective.

        Raises SceneError: a parameter of an own energy changes, and the stiffness is not affine in it.
        """
        if text := differs(materials, self.materials):
            raise SceneError(text)
        M_ee, K_ee = tissue_matrices(self.layers, materials)
        G, M_rigid = coupling(self.layers, materials, self.T)
        matrix = layered_viscosity(self.layers, materials)
        damping = replace(self.damping, matrix=matrix, beta=materials[0].beta if matrix is None else 0.0)
        return replace(self, materials=materials, M_ee=M_ee, K_ee=K_ee, G=G, M_rigid=M_rigid, damping=damping, kept={})


def whole_system(system: BlockSystem) -> BlockSystem:
    """The same system with all rows on every rank, for what ranks do by themselves. Collective.

    The affine components, and the points of finite strain, stay distributed and serve no rank alone.
    """
    layout, damping = system.layout, system.damping
    nodes, held = rows_on_all(layout.comm, layout.nodes), rows_on_all(layout.comm, layout.held)
    own = replace(layout, comm=MPI.COMM_SELF, n_local=layout.n_e, start=0, nodes=nodes, held=held, patches=None)
    M_ee, K_ee = whole_copy(system.M_ee), whole_copy(system.K_ee)
    T, G = rows_on_all(layout.comm, system.T), rows_on_all(layout.comm, system.G)
    if damping.matrix is not None:
        damping = replace(damping, matrix=whole_copy(damping.matrix))
    return replace(system, layout=own, M_ee=M_ee, K_ee=K_ee, T=T, G=G, damping=damping, kept={})


def sum_dense(terms: list[tuple[float, Array]]) -> Array:
    """Return sum_i a_i X_i of small dense arrays as a new Fortran-ordered array."""
    result = np.zeros(terms[0][1].shape, order="F")
    for factor, term in terms:
        result += factor * term
    return result


def _stiffness(layers: tuple[LayerBlocks, ...], materials: tuple[LayerMaterial, ...], block: str) -> list[Any]:
    """Factors and terms of K = sum over the layers of mu K_mu + lambda K_lambda, in one block."""
    return [
        (factor, getattr(component, block))
        for layer, m in zip(layers, materials, strict=True)
        for factor, component in ((m.stiff, layer.K_mu), (m.lam, layer.K_lambda))
    ]


def tissue_matrices(
    layers: tuple[LayerBlocks, ...], materials: tuple[LayerMaterial, ...]
) -> tuple[PETSc.Mat, PETSc.Mat]:
    """M_ee = sum rho M_1 and K_ee = sum mu K_mu + lambda K_lambda over the layers. Collective."""
    M = combine([(m.dense, layer.M_1.ee) for layer, m in zip(layers, materials, strict=True)])
    K = combine(_stiffness(layers, materials, "ee"))
    for A in (M, K):
        A.setOption(PETSc.Mat.Option.SPD, True)
    return M, K


def layered_viscosity(layers: tuple[LayerBlocks, ...], materials: tuple[LayerMaterial, ...]) -> PETSc.Mat | None:
    """D_ee = sum beta_k K_k + own terms; None when the layers share one beta and no term adds damping. Collective."""
    if len({m.beta for m in materials}) == 1 and all(m.adds != "damping" for m in materials):
        return None
    pairs = zip(layers, materials, strict=True)
    terms = ((m.viscous, x.K_mu.ee, m.beta * m.lam, x.K_lambda.ee) for x, m in pairs)
    return combine([term for a, K_mu, b, K_lambda in terms for term in ((a, K_mu), (b, K_lambda))])


def dynamic_stiffness(system: BlockSystem, s: float) -> PETSc.Mat:
    """K_ee + s D_ee + s^2 M_ee of the tissue at a real frequency s [1/s]. Collective."""
    damping = system.damping
    layers = [] if damping.matrix is None else [(s, damping.matrix)]
    return combine([(1 + s * damping.beta, system.K_ee), (s * s + s * damping.alpha, system.M_ee), *layers])


def coupling(layers: tuple[LayerBlocks, ...], materials: tuple[LayerMaterial, ...], T: Array) -> tuple[Array, Array]:
    """Return G = M_es + M_ee T, local rows, and M_rigid = [R; T]' M_h [R; T]. Collective."""
    G = np.zeros(T.shape, order="F")
    rigid = np.zeros((T.shape[1], T.shape[1]))
    for layer, material in zip(layers, materials, strict=True):
        part = layer.M_1.es + times_columns(layer.M_1.ee, T)
        comm = layer.M_1.ee.comm.tompi4py()
        rigid += material.dense * (layer.M_1.ss + total(comm, T.T @ part + layer.M_1.es.T @ T))
        G += material.dense * part
    return G, (rigid + rigid.T) / 2
