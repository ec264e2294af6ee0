"""Own terms: against matrices assembled by hand, against effects that they repeat, and refusals."""

from __future__ import annotations

import dolfinx.fem
import dolfinx.fem.petsc
import dolfinx.mesh
import numpy as np
import pytest
import ufl
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.errors import Paused
from softgrasp.fem.petsc import times_columns, total
from softgrasp.fem.run.simulate import RunOptions
from softgrasp.fem.solve.statics import equilibrium
from softgrasp.fem.strain.body import HyperelasticBody

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


def test_springs_of_a_layered_body_have_the_damping_that_no_layer_overrides():
    whole = {"low": {"box": [[0, 0], [1, 1]], "beta": 0.03}, "high": {"box": [[0, 1], [1, 2]], "beta": 0.05}}
    tissue = {
        "cells": [4, 8],
        "layers": {k: {**v, "material": {"mu": 30.0, "lambda": 30.0, "rho": 1.0}} for k, v in whole.items()},
    }
    plain = sg.build("paper_lqr", tissue=tissue).system
    own = sg.build("paper_lqr", tissue=tissue, terms=[sg.Term("bed", on_boundary, 30.0)]).system
    X = np.random.default_rng(1).standard_normal((plain.layout.n_local, 2))

    def more(matrix):
        return times_columns(matrix(own), X) - times_columns(matrix(plain), X)

    springs = more(lambda system: system.K_ee)
    lost = more(lambda system: system.damping.matrix)  # the scene's beta is 0.002 s
    assert np.abs(lost - 0.002 * springs).max() < 1e-12 * np.abs(springs).max()  # differences of sums of few entries


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
    "negative": (on_boundary, -1e4, {}, "not positive definite, so that some motion of the tissue has no force"),
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
def test_a_term_of_two_models_leaves_each_its_hash():
    """Its digest is that on a mesh; a run, a saved model and a restart file are found by the hash of the first."""
    bed = sg.Term("bed", on_boundary, 30.0)
    first = sg.build("paper_forward", KEYS, terms=[bed])
    before = first.scene_hash
    sg.build("paper_forward", ["tissue.cells=[3, 5]"], terms=[bed])
    assert first.scene_hash == before == sg.build("paper_forward", KEYS, terms=[bed]).scene_hash
    assert bed.digest == ""


@pytest.mark.serial
def test_keys_beside_a_loaded_scene_are_refused_with_terms_too():
    scene = sg.build("paper_forward", ["tissue.cells=[2, 4]"]).scene
    with pytest.raises(sg.fem.SceneError, match="need the file or the name of a scene"):
        sg.build(scene, ["tissue.cells=[3, 4]"], terms=[sg.Term("bed", on_boundary, 1.0)])


def whole_body(u, v):
    """Of all the body, for masses and dashpots."""
    return ufl.inner(u, v) * ufl.dx


def runs(keys, terms, other, **tables):
    """A run with terms, and one with keys that do the same."""
    own = sg.simulate(sg.build("paper_lqr", [*KEYS, *keys], terms=terms, **tables))
    same = sg.simulate(sg.build("paper_lqr", [*KEYS, *keys, *other], **tables))
    return own, same


def assert_same(own, same, digits=1e-10):
    for key in ("outputs", "q_s", "force", "energy", "dissipated"):
        one, two = getattr(own, key), getattr(same, key)
        assert np.abs(one - two).max() <= digits * max(np.abs(two).max(), 1e-300), key
    assert own.energy_drift < 1e-10


TWO_WAY = ["effects.reaction=true", "motion.drive='force'"]
BODY = {"effects": {"rotation": True, "frame": "hand"}, "hand": {"inertia": 1.0}, "motion": {"target": [1.0, 0.5, 0.1]}}
EFFECTS = {
    "one-way": [],
    "two-way": TWO_WAY,
    "undamped": ["effects.damping=false"],
    "finite strain": ["effects.finite_strain={}", "motion.target=[1.0, 0.5]"],
    "finite strain, two-way": ["effects.finite_strain={}", *TWO_WAY],
    "cg": ["time.solver='cg'", "time.rtol=1e-13"],
}


def on_ranks(*cases, alone=()):
    """Cases that run on ranks too, and those that run on one alone."""
    return [*(pytest.param(case, marks=pytest.mark.ranks) for case in cases), *alone]


@pytest.mark.parametrize("case", on_ranks("two-way", alone=["one-way", "finite strain"]))
def test_an_own_mass_of_all_the_body_is_more_density(case):
    weight = ["effects.gravity={g=[0.0, -0.3]}", *EFFECTS[case]]
    extra = sg.Term("ballast", whole_body, 0.7, adds="mass")
    assert_same(*runs(weight, [extra], ["tissue.material.rho=1.7"]), 1e-8 if "finite" in case else 1e-10)


@pytest.mark.parametrize("case", on_ranks("finite strain", alone=["one-way", "two-way"]))
def test_dashpots_in_all_the_body_are_rayleigh_damping(case):
    air = sg.Term("air", whole_body, 0.4, adds="damping")
    keys = [*EFFECTS[case], "effects.damping=false"]
    own, same = runs(keys, [air], ["effects.damping={kind='rayleigh',alpha=0.4,beta=0,drag='hand'}"])
    assert_same(own, same, 1e-8 if "finite" in case else 1e-10)  # the tolerance of a step at finite strain is 1e-9
    assert own.dissipated[-1] > 0


@pytest.mark.ranks(start="equilibrium", case=("two-way", "finite strain"))
@pytest.mark.parametrize("start", ["equilibrium", "rest"])
@pytest.mark.parametrize("case", list(EFFECTS))
def test_an_own_load_of_all_the_body_is_its_weight(case, start):
    """Equilibrium, reaction, work and damping of a load are those of gravity, whose code is another."""
    keys = [*EFFECTS[case], "effects.gravity={g=[0.0, 0.0]}", f"time.start='{start}'"]
    pull = sg.Term("pull", lambda v: (0.3 * v[0] - v[1]) * ufl.dx, 0.2, adds="load")
    own, same = runs(keys, [pull], ["effects.gravity={g=[0.06, -0.2]}"])
    assert_same(own, same, 1e-7 if "finite" in case else 1e-9)  # steps to 1e-9, solves to 1e-13 of larger loads
    half = sg.build("paper_lqr", [*KEYS, *keys], terms=[sg.Term("pull", pull.form, 0.1, adds="load")])
    if case == "one-way":
        assert_same(sg.simulate(half.with_parameters(pull=0.2)), same, 1e-9)


@pytest.mark.ranks
def test_a_pressure_has_the_resultant_and_moment_of_statics():
    """On the free lower side of a body in 2D, 1 m wide: p times its length, at the middle."""
    n = ufl.FacetNormal
    pressure = sg.Term(
        "pressure", lambda v: -ufl.dot(n(ufl.domain.extract_unique_domain(v)), v) * low(v) * ufl.ds, 3.0, adds="load"
    )
    keys = [
        "tissue.cells=[4, 8]",
        "effects.rotation=true",
        "hand.inertia=1.0",
        "hand.reference=[0.2, 0.0]",
        "motion.target=[1.0, 0.0, 0.0]",
    ]
    system = sg.build("paper_forward", keys, terms=[pressure], tissue={"thickness": 0.5}).system
    assert np.abs(system.own_wrench - 1.5 * np.array([0.0, 1.0, 0.3])).max() < 1e-13  # sums of a few numbers


def low(v):
    x = ufl.SpatialCoordinate(ufl.domain.extract_unique_domain(v))
    return ufl.conditional(x[1] < 1e-9, 1.0, 0.0)


@pytest.mark.ranks
def test_springs_at_finite_strain_keep_the_energy_and_carry_the_weight():
    bed = sg.Term("bed", on_boundary, 30.0)
    keys = [*KEYS, "effects.finite_strain={tol=1e-11}", "effects.damping=false", "effects.gravity={g=[0.0, -3.0]}"]
    model = sg.build("paper_lqr", [*keys, "motion.target=[1.0, 0.5]", "time.start='equilibrium'"], terms=[bed])
    system, comm = model.system, model.system.layout.comm
    system.release()  # keeps the matrix of the springs
    run = sg.simulate(model)
    assert run.energy_drift < 1e-11
    body = HyperelasticBody(system.points, system.materials, system.K_ee)
    z, f = system.K_ee.createVecs()
    z.array_w[:] = equilibrium(system)
    body.force(z, f)  # of the law alone
    V = model.space.V
    A = dolfinx.fem.petsc.assemble_matrix(dolfinx.fem.form(on_boundary(ufl.TrialFunction(V), ufl.TestFunction(V))))
    A.assemble()
    own = A.createSubMatrix(model.space.is_e, model.space.is_e)
    left = f.array_r + 30.0 * times_columns(own, z.array_r[:, None])[:, 0] - system.G @ system.gravity
    norms = total(comm, np.array([left @ left, f.array_r @ f.array_r]))
    assert norms[0] < (1e-9) ** 2 * norms[1]  # the equilibrium is solved to 1e-11
    soft = [*KEYS, "motion.target=[1e-4, 5e-5]", "effects.damping=false"]  # strains below 1e-4
    finite = sg.simulate(sg.build("paper_lqr", [*soft, "effects.finite_strain={}"], terms=[bed]))
    linear = sg.simulate(sg.build("paper_lqr", soft, terms=[bed]))
    bend = linear.outputs - linear.outputs_rigid
    assert np.abs(finite.outputs - linear.outputs).max() < 1e-3 * np.abs(bend).max()


@pytest.mark.parametrize("method", on_ranks("psd", alone=["craig_bampton", "psd_fixed", "pod_fixed"]))
@pytest.mark.parametrize("keys", [[], TWO_WAY], ids=["one-way", "two-way"])
def test_reduced_models_have_own_mass_damping_and_load_as_the_same_effects(method, keys):
    keys = [*KEYS, *keys, "effects.gravity={g=[0.0, 0.0]}", "effects.damping={kind='rayleigh',alpha=0.1,beta=0.002}"]
    terms = [
        sg.Term("ballast", whole_body, 0.7, adds="mass"),
        sg.Term("air", whole_body, 0.4, adds="damping"),
        sg.Term("pull", lambda v: (0.3 * v[0] - v[1]) * ufl.dx, 0.34, adds="load"),
    ]
    alpha = 0.1 + 0.4 / 1.7
    other = [
        "tissue.material.rho=1.7", "effects.gravity={g=[0.06, -0.2]}",
        f"effects.damping={{kind='rayleigh',alpha={alpha!r},beta=0.002}}",
    ]  # fmt: skip
    own, same = sg.build("paper_lqr", keys, terms=terms), sg.build("paper_lqr", [*keys, *other])
    small = []
    for model in (own, same):
        run = sg.simulate(model)
        rom = sg.reduce(model, run, method, N=12)
        small.append(sg.replay(rom, model, run, allow=True).outputs - run.outputs_rigid)
    assert np.abs(small[0] - small[1]).max() < 1e-6 * np.abs(small[1]).max()  # bases of snapshots equal to 1e-10


@pytest.mark.ranks
def test_a_stopped_run_with_an_own_load_goes_on_bit_by_bit(mpi_tmp_path):
    pull = sg.Term("pull", lambda v: v[0] * ufl.dx, 0.2, adds="load")

    def run(**how):
        model = sg.build("paper_lqr", KEYS, terms=[pull])
        return sg.simulate(model, RunOptions(directory=mpi_tmp_path, **how))

    whole = run()
    with pytest.raises(Paused):
        run(until=15)
    rest = run(resume=True)
    assert np.array_equal(rest.outputs, whole.outputs)
    assert rest.energy_drift == whole.energy_drift < 1e-11


REFUSED_VALUES = {
    "mass": (sg.Term("hole", whole_body, -2.0, adds="mass"), {}, "hole = -2: with that the mass matrix M_ee is not"),
    "damping": (sg.Term("motor", whole_body, -1.0, adds="damping"), {}, "would feed energy into some motion"),
    "indefinite": (sg.Term("mixed", lambda u, v: u[0] * v[0] * ufl.dx - u[1] * v[1] * ufl.dx, 1.0, adds="damping"),
                   {}, "its form would feed energy"),
    "two arguments": (sg.Term("p", lambda u, v: v[0] * ufl.dx, 1.0, adds="load"), {}, "ended with TypeError"),
    "bilinear": (sg.Term("p", lambda v: ufl.inner(v, v) * ufl.dx, 1.0, adds="load"), {}, "ended with|must be a linear"),
    "kind": (sg.Term("p", whole_body, 1.0, adds="glue"), {}, "choose stiffness, damping, mass, load"),
    "frame": (sg.Term("p", lambda v: v[0] * ufl.dx, 1.0, adds="load"), BODY, "effects.frame cannot go"),
}  # fmt: skip


@pytest.mark.ranks
@pytest.mark.parametrize("case", list(REFUSED_VALUES))
def test_values_and_kinds_that_make_no_sense_are_refused(case):
    term, tables, text = REFUSED_VALUES[case]
    with pytest.raises(sg.fem.SceneError, match=text):
        sg.build("paper_forward", ["tissue.cells=[2, 4]"], terms=[term], **tables)


@pytest.mark.ranks
def test_negative_values_are_refused_where_they_leave_no_solid_and_no_sooner():
    model = sg.build("paper_forward", ["tissue.cells=[2, 4]"], terms=[sg.Term("bed", on_boundary, 1.0)])
    assert model.with_parameters(bed=-0.5).states == model.states  # softer than the tissue: K stays definite
    with pytest.raises(sg.fem.SceneError, match="bed = -10000: with that the stiffness matrix"):
        model.with_parameters(bed=-1e4)


@pytest.mark.ranks
def test_springs_and_dashpots_go_with_a_hand_that_turns():
    """In its frame, by an angle whose square is 1e-8, they are those of small angles."""
    terms = [sg.Term("bed", on_boundary, 30.0), sg.Term("air", whole_body, 0.4, adds="damping")]
    keys = ["effects.rotation=true", "hand.inertia=1.0", "motion.target=[0.0, 0.0, 1e-4]", "effects.damping=false"]
    small, frame = (
        sg.simulate(sg.build("paper_lqr", [*KEYS, *keys, *more], terms=terms))
        for more in ([], ["effects.frame='hand'"])
    )
    one, two = (run.outputs - run.outputs_rigid for run in (frame, small))
    assert np.abs(one - two).max() < 1e-3 * np.abs(two).max()  # of the order of the angle
    assert frame.dissipated[-1] == pytest.approx(small.dissipated[-1], rel=1e-3)
