"""Own terms of the stiffness: against matrices assembled by hand, with reduced models, restarts' hash and refusals."""

from __future__ import annotations

import dolfinx.fem
import dolfinx.fem.petsc
import dolfinx.mesh
import numpy as np
import pytest
import ufl
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.petsc import times_columns, total

KEYS = ["tissue.cells=[4, 8]", "time.steps=40", "time.end=4.0"]


def on_boundary(u, v):
    """Springs all over the boundary that are stiffer at the bottom."""
    x = ufl.SpatialCoordinate(ufl.domain.extract_unique_domain(u))
    return (2 - x[1]) * ufl.inner(u, v) * ufl.ds


@pytest.mark.ranks
@pytest.mark.parametrize("order", [1, 2])
def test_a_term_adds_its_matrix_and_follows_its_parameter(order):
    keys = [*KEYS, f"tissue.order={order}"]
    plain = sg.build("paper_lqr", keys)
    model = sg.build("paper_lqr", keys, terms=[sg.Term("bed", on_boundary, 30.0)])
    V = model.space.V
    A = dolfinx.fem.petsc.assemble_matrix(dolfinx.fem.form(on_boundary(ufl.TrialFunction(V), ufl.TestFunction(V))))
    A.assemble()
    own = A.createSubMatrix(model.space.is_e, model.space.is_e)
    for bed, built in ((30.0, model), (70.0, model.with_parameters(bed=70.0))):
        X = np.random.default_rng(model.system.layout.start).standard_normal((model.system.layout.n_local, 2))
        mine = times_columns(built.system.K_ee, X)
        wanted = times_columns(plain.system.K_ee, X) + bed * times_columns(own, X)
        assert np.abs(mine - wanted).max(initial=0.0) < 1e-13 * np.abs(wanted).max(initial=1.0)  # sums of few entries
    assert model.scene_hash != plain.scene_hash
    # a rigid move of hand and tissue leaves the term at rest: the paper's K_es is -K_ee T
    assert np.abs(model.system.K_es + times_columns(model.system.K_ee, model.system.T)).max(initial=0.0) < 1e-11 * 50
    beta = model.system.damping.beta
    assert beta == plain.system.damping.beta > 0  # Kelvin-Voigt damping includes the term, without a matrix


@pytest.mark.ranks
def test_reduced_models_and_feedback_know_the_parameter():
    model = sg.build("paper_lqr", KEYS, terms=[sg.Term("bed", on_boundary, 30.0)])
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=14)
    other = model.with_parameters(bed=90.0)
    Phi = rom.reconstruction.L_q
    K_r = total(model.system.layout.comm, Phi.T @ times_columns(other.system.K_ee, Phi))
    small = rom.parameters(other.system.materials).stiffness(rom.parts["K_mu"], rom.parts["K_lambda"])
    largest = [float(np.linalg.eigvalsh(X)[-1]) for X in (small, K_r)]
    assert abs(largest[0] / largest[1] - 1) < 1e-10  # the same columns: rounding of products
    assert sg.solve(sg.problem(other)).residual < 1e-8  # its own tolerance is below


REFUSED = {
    "linear": (lambda u, v: v[0] * ufl.ds, 1.0, {}, "must be a bilinear form"),
    "jumps": (lambda u, v: ufl.inner(ufl.avg(u), ufl.avg(v)) * ufl.dS, 1.0, {}, "must be a bilinear form"),
    "unsymmetric": (lambda u, v: u[0] * v[1] * ufl.dx, 1.0, {}, "not symmetric"),
    "not linear": (lambda u, v: u[0] * ufl.inner(u, v) * ufl.dx, 1.0, {}, "ended with ArityMismatch"),
    "no measure": (lambda u, v: ufl.inner(u, v), 1.0, {}, "returned no form"),
    "no such tag": (lambda u, v: ufl.inner(u, v) * ufl.ds(99), 1.0, {}, "adds nothing to the stiffness"),
    "fails": (lambda u, v: u[7] * v[7] * ufl.dx, 1.0, {}, "ended with"),
    "value": (on_boundary, float("nan"), {}, "give a finite number"),
    "finite strain": (on_boundary, 1.0, {"effects": {"finite_strain": {}}}, "cannot go with effects.finite_strain"),
}


@pytest.mark.parametrize("case", list(REFUSED))
def test_what_is_no_term_is_refused(case):
    form, value, tables, text = REFUSED[case]
    with pytest.raises(sg.fem.SceneError, match=text):
        sg.build("paper_forward", ["tissue.cells=[2, 4]"], terms=[sg.Term("bed", form, value)], **tables)


@pytest.mark.serial
def test_names_of_terms_are_their_own():
    for name in ("mu", "two words"):
        with pytest.raises(sg.fem.SceneError, match="needs a name of its own"):
            sg.build("paper_forward", ["tissue.cells=[2, 4]"], terms=[sg.Term(name, on_boundary, 1.0)])
    with pytest.raises(sg.fem.SceneError, match="give a list of"):
        sg.build("paper_forward", ["tissue.cells=[2, 4]"], terms=sg.Term("bed", on_boundary, 1.0))
    with pytest.raises(sg.fem.SceneError, match="terms has 3"):
        sg.build("paper_forward", ["tissue.cells=[2, 4]"], terms=[3])


@pytest.mark.ranks
def test_the_hash_knows_where_a_term_acts():
    """One form on the left and the right side: its signature, norm and total force are the same."""
    domain = dolfinx.mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [1.0, 2.0]], [4, 8])
    hashes = set()
    for side in (0.0, 1.0, 1.0):
        facets = dolfinx.mesh.locate_entities_boundary(domain, 1, lambda x, side=side: np.isclose(x[0], side))
        tags = dolfinx.mesh.meshtags(domain, 1, np.sort(facets), np.full(len(facets), 5, dtype=np.int32))
        ds = ufl.Measure("ds", domain=domain, subdomain_data=tags)
        bed = sg.Term("bed", lambda u, v, ds=ds: ufl.inner(u, v) * ds(5), 1.0)
        hashes.add(sg.build("paper_forward", mesh=domain, terms=[bed]).scene_hash)
    assert len(hashes) == 2


@pytest.mark.serial
def test_keys_beside_a_loaded_scene_are_refused_with_terms_too():
    scene = sg.build("paper_forward", ["tissue.cells=[2, 4]"]).scene
    with pytest.raises(sg.fem.SceneError, match="need the file or the name of a scene"):
        sg.build(scene, ["tissue.cells=[3, 4]"], terms=[sg.Term("bed", on_boundary, 1.0)])
