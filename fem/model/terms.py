"""Own terms of the stiffness: bilinear forms with a parameter each, in the blocks of hand and tissue.

K_ee = (stiffness of the tissue) + sum over terms of value times form(z, v), z the displacement against the hand: a
spring or foundation moves with the hand, so K_es = -K_ee T holds for it as for the tissue, and a rigid move costs
nothing.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

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
from softgrasp.fem.system import Component, LayerBlocks

SYMMETRIC = 1e-10  # largest |A - A'| over |A| of a symmetric form [1]


@dataclass
class Term:
    """One more part of the stiffness, K_ee = K_tissue + value K_form: springs, a foundation or another symmetric form.

    Attributes:
        name: name of its parameter, by which `Model.with_parameters` changes it.
        form: function of u and v that returns a symmetric bilinear form in UFL, on cells (ufl.dx) or the boundary
            (ufl.ds), in 2D for a thickness of 1 m; u is the displacement against the hand.
        value: value of the parameter [N/m^3 for springs on a surface].
        digest: hash of the form on the mesh of its model, empty before there is one.

    Raises:
        SceneError: in `softgrasp.build`: a name is taken, a value not finite, a form zero, not symmetric or not
            bilinear.

    >>> import softgrasp as sg
    >>> import ufl
    >>> bed = sg.Term("bed", lambda u, v: ufl.inner(u, v) * ufl.ds, 20.0)
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]"], terms=[bed])
    >>> model.with_parameters(bed=40.0).states
    160
    """

    name: str
    """name of its parameter [no unit]"""
    form: Callable[[Any, Any], Any]
    """symmetric bilinear form of (u, v) in UFL, for a thickness of 1 m [m^d]"""
    value: float
    """value of the parameter [N/m^3 for springs on a surface]"""
    digest: str = field(default="", repr=False, compare=False)
    """hash of the form on the mesh of its model [no unit]"""


def with_terms(scene: Scene, terms: Sequence[Term]) -> Scene:
    """The scene with own terms. Raises SceneError: a name or value is none, or finite strain is on."""
    if isinstance(terms, Term) or not isinstance(terms, Sequence):
        raise SceneError(f"terms is {shortened(repr(terms))}; give a list of softgrasp.Term(name, form, value)")
    names = [*TAKEN, *scene.tissue.parameters]
    for term in terms:
        if not isinstance(term, Term):
            raise SceneError(f"terms has {shortened(repr(term))}; give softgrasp.Term(name, form, value)")
        if not str(term.name).isidentifier() or term.name in names:
            raise SceneError(f"the term '{term.name}' needs a name of its own, a word of letters and digits")
        if not isinstance(term.value, Real) or not math.isfinite(term.value):
            raise SceneError(f"the term {term.name} has the value {shortened(repr(term.value))}; give a finite number")
        names.append(term.name)
    if terms and scene.effects.finite_strain is not None:
        raise SceneError("own terms cannot go with effects.finite_strain yet; set one of them to false")
    result = scene.changed(lambda keys: None)
    result._terms = tuple(terms)
    return result


def term_blocks(
    space: Discretisation, scene: Scene, blocks: Blocks, T: Any, rows: tuple[LayerMaterial, ...]
) -> tuple[tuple[LayerBlocks, ...], tuple[LayerMaterial, ...]]:
    """A row of blocks and a material for each own term of a scene; damping beta K includes them. Collective.

    Args:
        blocks: assembles the forms.
        T: rigid modes at the free nodes, local rows (n_local, n_s).
        rows: materials of the layers.

    Raises SceneError: a form cannot be made, is zero or not symmetric, or joins cells across facets.
    """
    scene.refuse_frame("an own term")
    comm, found, materials = space.layout.comm, list[LayerBlocks](), list[LayerMaterial]()
    damping = scene.effects.damping
    for term in scene._terms:
        u, v = ufl.TrialFunction(space.V), ufl.TestFunction(space.V)
        with raise_on_all_ranks(comm):
            form = _checked(term, u, v)
        with raise_on_all_ranks(comm):
            _compiled(term, form)
        ee = blocks.whole(form).ee
        if not ee.isSymmetric(SYMMETRIC * max(ee.norm(PETSc.NormType.INFINITY), 1e-300)):
            raise SceneError(f"the term {term.name} is not symmetric in u and v; a spring has an energy")
        size = ee.norm(PETSc.NormType.FROBENIUS)
        if not 0 < size < math.inf:
            raise SceneError(
                f"the term {term.name} adds {'nothing' if size == 0 else 'no finite number'} to the stiffness; check "
                "its form, and that a tag of its measure (subdomain_data) is in the mesh"
            )
        zero = ee.duplicate(copy=False)
        zero.zeroEntries()
        moved = times_columns(ee, T)
        own = Component(ee, -moved, total(comm, T.T @ moved))
        X = _affine_moves(space)
        gram = total(comm, X.T @ times_columns(ee, X))
        # by pi: sums of another order on other ranks must not round to another digit, as ties of such meshes would
        shares = np.round(gram / (math.pi * max(np.abs(gram).max(), 1e-300)), 6) + 0.0
        text = f"{form.signature()} {size / math.pi:.6e} {shares.tolist()}"
        term.digest = hashlib.sha256(text.encode()).hexdigest()
        nothing = Component(zero, np.zeros_like(moved), np.zeros_like(own.ss))
        found.append(LayerBlocks(f"term.{term.name}", own, nothing, nothing))
        beta = 0.0 if damping is None else rows[-1].beta
        materials.append(LayerMaterial(0.0, float(term.value), rows[0].rho, beta, term.name))
    return tuple(found), tuple(materials)


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


def _checked(term: Term, u: Any, v: Any) -> Any:
    try:
        form = term.form(u, v)
        if not isinstance(form, ufl.Form):
            raise TypeError("it returned no form, which ends with * ufl.dx or * ufl.ds")
        kinds = {integral.integral_type() for integral in form.integrals()}
        rank = len(form.arguments())
        ufl.algorithms.compute_form_data(form)  # here on every rank: where DOLFINx compiles on one, others would wait
    except (Exception, ArityMismatch) as error:  # which is no Exception
        text = f"{type(error).__name__}: {shortened(str(error))}"
        raise SceneError(f"the term {term.name}: its form(u, v) ended with {text}") from error
    if rank != 2 or not kinds <= {"cell", "exterior_facet"}:
        raise SceneError(f"the term {term.name} must be a bilinear form in u and v on cells (dx) or the boundary (ds)")
    return form


def _compiled(term: Term, form: Any) -> None:
    """Compile a form that all ranks have. Collective."""
    try:
        dolfinx.fem.form(form)
    except Exception as error:
        text = f"{type(error).__name__}: {shortened(str(error))}"
        raise SceneError(f"the term {term.name}: its form(u, v) cannot be compiled, {text}") from error
