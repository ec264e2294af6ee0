"""Own terms of stiffness, damping, mass and load: forms with a parameter each, in the blocks of hand and tissue.

    (M + sum m M_form) z'' + (D + sum d D_form) z' + (K + sum k K_form) z = -G (a_s - g) + sum p f_form

Springs and dashpots act on z, the displacement against the hand, and move with it: K_es = -K_ee T holds for them as for
the tissue, and a rigid move needs no force. An own mass moves with the tissue, so that it is part of G and M_rigid, and
has weight. A load keeps its direction in space; on hand and tissue that move rigidly it does the work of R'f + T'f_e.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, Literal, get_args

import dolfinx.fem
import numpy as np
import ufl
import ufl.algorithms
from ufl.algorithms.check_arities import ArityMismatch

from softgrasp.fem.errors import SceneError, raise_on_all_ranks, shortened
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.assembly import Blocks, Discretisation
from softgrasp.fem.petsc import PETSc, times_columns, total
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.tissue import TAKEN
from softgrasp.fem.system import Component, LayerBlocks, tissue_matrices

SYMMETRIC = 1e-10  # largest |A - A'| over |A| of a symmetric form [1]
SEMIDEFINITE = 1e-10  # most negative eigenvalue of a form over its norm that counts as rounding [1]
Adds = Literal["stiffness", "damping", "mass", "load"]
MATRIX = {"stiffness": "K_ee", "mass": "M_ee"}
ACTS = {
    "stiffness": "some motion of the tissue has no force that pulls it back",
    "mass": "some motion of the tissue has no inertia",
}


@dataclass
class Term:
    """One more part of the equations: K = K_tissue + value K_form, the same of D or M, or a load value f_form.

    Attributes:
        name: name of its parameter, by which `Model.with_parameters` changes it.
        form: function of u and v that returns a symmetric bilinear form in UFL, of v alone that returns a linear one
            for a load, on cells (ufl.dx) or the boundary (ufl.ds), in 2D for a thickness of 1 m; u is the displacement
            against the hand, of a mass the displacement in space.
        value: value of the parameter [N/m^3 for springs on a surface, Pa for a pressure].
        adds: "stiffness", "damping", "mass" or "load".
        digest: hash of the form on the mesh of its model, empty before there is one.

    Raises:
        SceneError: in `softgrasp.build`: a name is used already, a value not finite, a form zero, not symmetric or not
            (bi)linear, stiffness or mass not positive definite with it, or damping that feeds energy.

    >>> import softgrasp as sg
    >>> import ufl
    >>> bed = sg.Term("bed", lambda u, v: ufl.inner(u, v) * ufl.ds, 20.0)
    >>> push = sg.Term("push", lambda v: v[0] * ufl.dx, 0.3, adds="load")
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]"], terms=[bed, push])
    >>> model.with_parameters(bed=40.0, push=0.1).states
    160
    """

    name: str
    """name of its parameter [no unit]"""
    form: Callable[..., Any]
    """symmetric bilinear form of (u, v), linear form of (v) for a load, in UFL, for a thickness of 1 m [m^d]"""
    value: float
    """value of the parameter [N/m^3 for springs on a surface, Pa for a pressure]"""
    adds: Adds = "stiffness"
    """what it adds to [no unit]"""
    digest: str = field(default="", repr=False, compare=False)
    """hash of the form on the mesh of its model [no unit]"""


def with_terms(scene: Scene, terms: Sequence[Term]) -> Scene:
    """The scene with own terms. Raises SceneError: a name or value is none, or an effect cannot go with one."""
    if isinstance(terms, Term | str) or not isinstance(terms, Sequence):
        raise SceneError(f"terms is {shortened(repr(terms))}; give a list of softgrasp.Term(name, form, value)")
    names = [*TAKEN, *scene.tissue.parameters]
    for term in terms:
        if not isinstance(term, Term):
            raise SceneError(f"terms has {shortened(repr(term))}; give softgrasp.Term(name, form, value)")
        if not str(term.name).isidentifier() or term.name in names:
            raise SceneError(f"the term '{term.name}' needs a name of its own, a word of letters and digits")
        if not isinstance(term.value, Real) or not math.isfinite(term.value):
            raise SceneError(f"the term {term.name} has the value {shortened(repr(term.value))}; give a finite number")
        if term.adds not in get_args(Adds):
            raise SceneError(
                f"the term {term.name} adds {shortened(repr(term.adds))}; choose {', '.join(get_args(Adds))}"
            )
        names.append(term.name)
        effects = scene.effects
        if term.adds in ("mass", "load"):
            for key, on in (("frame", effects.frame is not None), ("obstacles", effects.obstacles)):
                if on:
                    raise SceneError(
                        f"the term {term.name} adds a {term.adds}, which effects.{key} cannot go with; leave one out"
                    )
    result = scene.changed(lambda keys: None)
    result._terms = tuple(terms)
    return result


def term_blocks(
    space: Discretisation, scene: Scene, blocks: Blocks, T: Any, rows: tuple[LayerMaterial, ...]
) -> tuple[tuple[LayerBlocks, ...], tuple[LayerMaterial, ...]]:
    """A row of blocks and a material for each own term of a scene; damping beta K includes springs. Collective.

    Args:
        blocks: assembles the forms.
        T: rigid modes at the free nodes, local rows (n_local, n_s).
        rows: materials of the layers.

    Raises SceneError: a form cannot be made, is zero or not symmetric, or joins cells across facets.
    """
    comm, found, materials = space.layout.comm, list[LayerBlocks](), list[LayerMaterial]()
    scene._terms = tuple(map(copy, scene._terms))  # with digests on this mesh; another model has the same terms too
    beta = 0.0 if scene.effects.damping is None else scene.effects.damping.beta
    nothing: Component | None = None
    for term in scene._terms:
        u, v = ufl.TrialFunction(space.V), ufl.TestFunction(space.V)
        with raise_on_all_ranks(comm):
            form = _checked(term, [v] if term.adds == "load" else [u, v])
        with raise_on_all_ranks(comm):
            compiled = _compiled(term, form)
        nothing = nothing or _nothing(space, blocks, T)
        found.append(_row(term, form, compiled, space, blocks, nothing, scene.tissue.thickness, T))
        materials.append(LayerMaterial(0.0, float(term.value), rows[0].rho, beta, term.name, adds=term.adds))
    return tuple(found), tuple(materials)


def _row(
    term: Term, form: Any, compiled: Any, space: Discretisation, blocks: Blocks, nothing: Component, thickness: float,
    T: Any,
) -> LayerBlocks:  # fmt: skip
    """The blocks of a term; sets its digest. Collective."""
    comm, definite, load, own = space.layout.comm, True, None, nothing
    if term.adds == "load":
        load = _load(space, compiled, thickness, T)
        size = math.sqrt(total(comm, np.array([load[0] @ load[0]]))[0] + load[1] @ load[1])
    else:
        own = blocks.whole(form, symmetric=False)  # which is asked below
        size = own.ee.norm(PETSc.NormType.FROBENIUS)
    if not 0 < size < math.inf:
        raise SceneError(
            f"the term {term.name} adds {'nothing' if size == 0 else 'no finite number'} to the {term.adds}; check "
            "its form, and that a tag of its measure (subdomain_data) is in the mesh"
        )
    if load is None:
        if not own.ee.isSymmetric(SYMMETRIC * own.ee.norm(PETSc.NormType.INFINITY)):
            raise SceneError(f"the term {term.name} is not symmetric in u and v; a spring has an energy")
        definite = _positive(own.ee, SEMIDEFINITE * size)
    if term.adds in ("stiffness", "damping"):  # which a rigid move does not feel
        moved = times_columns(own.ee, T)
        own = Component(own.ee, -moved, total(comm, T.T @ moved))
    term.digest = _digest(term, form, size, own, load, space)
    place = "M_1" if term.adds == "mass" else "K_mu"
    parts = {key: own if key == place else nothing for key in ("K_mu", "K_lambda", "M_1")}
    return LayerBlocks(f"term.{term.name}", **parts, load=load, definite=definite)


def check_values(layers: Sequence[LayerBlocks], materials: Sequence[LayerMaterial]) -> None:
    """Refuse values of own terms with which stiffness or mass is not positive definite, or damping feeds energy.

    A factor is made only where a value is negative or a form is not semidefinite. Collective.
    """
    for i, adds in enumerate(("mass", "stiffness")):
        rows = [(x, m) for x, m in zip(layers, materials, strict=True) if m.adds == adds]
        doubtful = [m for x, m in rows if m.mu < 0 or not (x.definite or m.mu == 0)]
        if doubtful and not _positive(tissue_matrices(tuple(layers), tuple(materials))[i]):
            values = ", ".join(f"{m.part} = {m.mu:g}" for m in doubtful)
            raise SceneError(
                f"{values}: with that the {adds} matrix {MATRIX[adds]} is not positive definite, so that {ACTS[adds]}; "
                "give a larger value or another form"
            )
    for x, m in zip(layers, materials, strict=True):
        if m.adds == "damping" and (m.mu < 0 or not x.definite):
            raise SceneError(
                f"{m.part} = {m.mu:g}: {'its form' if m.mu >= 0 else 'a negative value'} would feed energy into some "
                "motion; damping needs a form that is never negative and a value >= 0"
            )


def _positive(A: PETSc.Mat, shift: float = 0.0) -> bool:
    """Whether A + shift I has positive pivots only, by a factor L D L'. Collective."""
    X, pc = A.copy(), PETSc.PC().create(A.comm)
    if shift:
        X.shift(shift)
    X.setOption(PETSc.Mat.Option.SPD, False)
    X.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    pc.setOptionsPrefix("inertia_")  # none of the user's: the answer must not depend on them
    pc.setType("cholesky")
    pc.setFactorSolverType("mumps")
    pc.setOperators(X)
    try:
        pc.setFactorSetUpSolverType()
        factor = pc.getFactorMatrix()
        factor.setMumpsIcntl(13, 1)  # else the count of the root front is missing on ranks
        factor.setMumpsIcntl(24, 1)
        pc.setUp()
        negative, zero, _ = pc.getFactorMatrix().getInertia()
        return bool(negative == 0 and zero == 0)
    finally:
        pc.destroy()
        X.destroy()


def _nothing(space: Discretisation, blocks: Blocks, T: Any) -> Component:
    """A component of zeros, with the pattern of the others. Collective."""
    u, v = ufl.TrialFunction(space.V), ufl.TestFunction(space.V)
    ee = blocks.whole(ufl.inner(u, v) * ufl.dx).ee
    ee.zeroEntries()
    return Component(ee, np.zeros(T.shape, order="F"), np.zeros((T.shape[1], T.shape[1])))


def _load(space: Discretisation, compiled: Any, thickness: float, T: Any) -> tuple[Any, Any]:
    """The load at value 1 on the free nodes, and R'f + T'f_e on hand and tissue that move rigidly. Collective."""
    vector = dolfinx.fem.assemble_vector(compiled)
    vector.scatter_reverse(dolfinx.la.InsertMode.add)
    f, d = thickness * vector.array[: len(space.R)], space.layout.dimension
    free = np.ascontiguousarray(f.reshape(-1, d)[space.free].ravel())
    return free, total(space.layout.comm, space.R.T @ f + T.T @ free)


def _digest(term: Term, form: Any, size: float, own: Component, load: Any, space: Discretisation) -> str:
    """Hash of a form by what it does to affine moves. Collective."""
    comm, X = space.layout.comm, _affine_moves(space)
    work = X.T @ times_columns(own.ee, X) if load is None else X.T @ load[0]
    gram = total(comm, work)
    # by pi: sums of another order on other ranks must not round to another digit, as ties of such meshes would
    shares = np.round(gram / (math.pi * max(np.abs(gram).max(), 1e-300)), 6) + 0.0
    kind = "" if term.adds == "stiffness" else f"{term.adds} "
    text = f"{kind}{form.signature()} {size / math.pi:.6e} {shares.tolist()}"
    return hashlib.sha256(text.encode()).hexdigest()


def _affine_moves(space: Discretisation) -> Any:
    """Displacements e_i and x_j e_i at the free nodes, local rows (n_local, d + d d).

    The signature of a form has neither the values of its constants nor the facets of its tags: the work of a term on
    these says how stiff it is, and where.
    """
    d, first = space.layout.dimension, space.V.dofmap.index_map.local_range[0]
    node, component = np.divmod(space.is_e.indices - d * first, d)
    x = space.V.tabulate_dof_coordinates()[node, :d]
    unit = np.eye(d)[component]
    return np.hstack([unit, *(x[:, j : j + 1] * unit for j in range(d))])


def _checked(term: Term, arguments: Sequence[Any]) -> Any:
    try:
        form = term.form(*arguments)
        if not isinstance(form, ufl.Form):
            raise TypeError("it returned no form, which ends with * ufl.dx or * ufl.ds")
        kinds = {integral.integral_type() for integral in form.integrals()}
        rank = len(form.arguments())
        ufl.algorithms.compute_form_data(form)  # here on every rank: where DOLFINx compiles on one, others would wait
    except (Exception, ArityMismatch) as error:  # which is no Exception
        text = f"{type(error).__name__}: {shortened(str(error))}"
        raise SceneError(f"the term {term.name}: its form({_of(term)}) ended with {text}") from error
    if rank != len(arguments) or not kinds <= {"cell", "exterior_facet"}:
        what = "linear form in v" if term.adds == "load" else "bilinear form in u and v"
        raise SceneError(f"the term {term.name} must be a {what} on cells (dx) or the boundary (ds)")
    return form


def _compiled(term: Term, form: Any) -> Any:
    """Compile a form that all ranks have. Collective."""
    try:
        return dolfinx.fem.form(form)
    except Exception as error:
        text = f"{type(error).__name__}: {shortened(str(error))}"
        raise SceneError(f"the term {term.name}: its form({_of(term)}) cannot be compiled, {text}") from error


def _of(term: Term) -> str:
    return "v" if term.adds == "load" else "u, v"
