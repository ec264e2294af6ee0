"""Force and tangent of finite strain: against FFCx's form, scikit-fem, K_ee and differences, on 1, 2 and 3 ranks."""

from __future__ import annotations

from typing import Any

import dolfinx.fem
import numpy as np
import pytest
import skfem
import ufl
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.assembly import make_points
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import SAME, PETSc, to_scipy, total
from softgrasp.fem.strain.body import HyperelasticBody
from softgrasp.fem.strain.laws import volume_change
from softgrasp.fem.strain.points import whole_points
from tests.helpers.models import (
    CUBE,
    LAYERS,
    Array,
    close,
    gather_matrix,
    gather_mesh,
    gather_rows,
    local_rows,
    make_scene,
    node_order,
)

FLAT: dict[str, Any] = {"tissue": {"cells": [3, 6], "thickness": 0.3}}
LAWS = ("neo-hooke", "neo-hooke-quadratic", "stvk")
BODIES = [
    pytest.param(changes, order, law, id=f"{name}-p{order}-{law}")
    for changes, name in ((FLAT, "2d"), (CUBE, "3d"))
    for order in (1, 2)
    for law in LAWS
] + [pytest.param(FLAT, 3, "neo-hooke", id="2d-p3-neo-hooke")]


def model_of(changes: dict[str, Any], order: int, law: str, **tables: Any) -> Model:
    scene = make_scene(changes, {"tissue": {"order": order}, "effects": {"finite_strain": {"law": law}}}, tables)
    return build(scene)


def vector(model: Model, z: Array) -> PETSc.Vec:
    result = model.system.K_ee.createVecRight()
    result.array_w[:] = z
    return result


def bent(model: Model, size: float = 0.03) -> Array:
    """A smooth large displacement that inverts no cell, local rows."""
    x = model.system.layout.nodes
    k = np.arange(x.shape[1])
    return size * np.stack([np.cos(1.1 * x @ np.roll(1.0 + k, i) + i) for i in k], axis=1).ravel()


def ffcx_force(model: Model, z: Array) -> Array:
    """dW/dz by UFL's derivative of the energy and FFCx's quadrature, local rows. Collective."""
    space, scene = model.space, model.scene
    V, d = space.V, space.layout.dimension
    u, v, one = dolfinx.fem.Function(V), ufl.TestFunction(V), ufl.Identity(d)
    lam, mu = scene.tissue.material.lam, scene.tissue.material.mu
    F = ufl.variable(one + ufl.grad(u))
    J, E = ufl.det(F), (F.T * F - one) / 2
    shear = mu / 2 * (ufl.tr(F.T * F) - d) - mu * ufl.ln(J)
    W = {
        "neo-hooke": shear + lam / 2 * ufl.ln(J) ** 2,
        "neo-hooke-quadratic": shear + lam / 2 * (J - 1) ** 2,
        "stvk": mu * ufl.inner(E, E) + lam / 2 * ufl.tr(E) ** 2,
    }[scene.effects.finite_strain.law]  # type: ignore[union-attr]
    dx = ufl.dx(metadata={"quadrature_degree": 1 if scene.tissue.order == 1 else 2 * scene.tissue.order})
    form = dolfinx.fem.form(ufl.inner(ufl.diff(W, F), ufl.grad(v)) * dx)
    u.x.array.reshape(-1, d)[space.free] = z.reshape(-1, d)
    u.x.scatter_forward()
    b = dolfinx.fem.assemble_vector(form)
    b.scatter_reverse(dolfinx.la.InsertMode.add)
    return np.asarray(b.array.reshape(-1, d)[space.free].ravel() * scene.tissue.thickness)


@pytest.mark.ranks
@pytest.mark.parametrize(("changes", "order", "law"), BODIES)
def test_force_is_ffcx_s_and_tangent_its_derivative(changes: dict[str, Any], order: int, law: str) -> None:
    """Same quadrature, same element: equal but for the order of additions; K(0) = K_ee in pattern and numbers."""
    model = model_of(changes, order, law)
    system, comm = model.system, model.system.layout.comm
    assert system.points is not None
    body = HyperelasticBody(system.points, system.materials, system.K_ee)
    volume = np.prod(model.scene.tissue.size) * model.scene.tissue.thickness  # type: ignore[arg-type]
    assert system.points.vol.min() > 0
    assert total(comm, np.array([system.points.vol.sum()]))[0] == pytest.approx(volume, rel=1e-13)
    K = body.tangent(vector(model, np.zeros(system.layout.n_local)))
    ours, linear = to_scipy(K), to_scipy(system.K_ee)
    assert np.array_equal(ours.indptr, linear.indptr)
    assert np.array_equal(ours.indices, linear.indices)
    assert abs(ours - linear).max() <= 1e-13 * abs(linear).max()
    K.axpy(1.0, system.M_ee, SAME)  # as steps do: PETSc adds columns of other ranks by their place, not their number
    both = linear + to_scipy(system.M_ee)
    assert abs(to_scipy(K) - both).max() <= 1e-13 * abs(both).max()
    z = bent(model)
    assert volume_change(body.gradient(vector(model, z))).min(initial=0.0) > -0.7
    f = vector(model, z)
    body.force(vector(model, z), f)
    expected = gather_rows(system.layout, ffcx_force(model, z))
    assert close(gather_rows(system.layout, f.array_r), expected) <= 1e-13
    K = body.tangent(vector(model, z))
    dz, step = bent(model, 1.0)[::-1].copy(), 1e-6
    change = []
    for sign in (1, -1):
        body.force(vector(model, z + sign * step * dz), f)
        change.append(sign * f.array_r / (2 * step))
    K.mult(vector(model, dz), f)
    assert close(gather_rows(system.layout, f.array_r), gather_rows(system.layout, sum(change))) < 1e-8
    energies = [total(comm, np.array([body.energy(vector(model, z + s * step * dz))]))[0] for s in (1, -1)]
    body.force(vector(model, z), f)
    work = total(comm, np.array([np.dot(f.array_r, dz)]))[0]
    assert (energies[0] - energies[1]) / (2 * step) == pytest.approx(work, rel=1e-7)


@pytest.mark.ranks
@pytest.mark.parametrize("changes", [FLAT, CUBE], ids=["2d", "3d"])
def test_force_is_scikit_fem_s(changes: dict[str, Any]) -> None:
    """The neo-Hookean force on the same mesh by another code, where H is constant in every cell."""
    model = model_of(changes, 1, "neo-hooke")
    system, d = model.system, model.system.layout.dimension
    points, cells = gather_mesh(model.space.mesh.mesh)
    mesh = (skfem.MeshTri if d == 2 else skfem.MeshTet)(points.T.copy(), cells.T.astype(np.int64).copy())
    scalar = skfem.ElementTriP1() if d == 2 else skfem.ElementTetP1()
    basis = skfem.Basis(mesh, skfem.ElementVector(scalar), intorder=1)
    lam, mu = model.scene.tissue.material.lam, model.scene.tissue.material.mu

    @skfem.LinearForm
    def force(v: Any, w: Any) -> Any:
        F = w.u.grad + np.eye(d)[:, :, None, None]
        turned = F.transpose(2, 3, 0, 1)
        inverse, J = np.linalg.inv(turned).transpose(2, 3, 0, 1), np.linalg.det(turned)
        P = mu * F + (lam * np.log(J) - mu) * inverse.swapaxes(0, 1)
        return np.einsum("ijqp,ijqp->qp", P, v.grad)

    layout = system.layout
    nodes = np.concatenate(layout.comm.allgather(layout.nodes))
    nodes = nodes[node_order(nodes)]
    z = gather_rows(layout, bent(model))
    component = np.zeros(basis.N, dtype=int)
    for c, dofs in enumerate(basis.nodal_dofs):
        component[dofs] = c
    where = basis.doflocs.T
    key = {tuple(np.round(x, 9)): i for i, x in enumerate(nodes)}
    at = np.array([key.get(tuple(np.round(x, 9)), -1) for x in where])
    u = np.where(at >= 0, z.reshape(-1, d)[at, component], 0.0)
    full = force.assemble(basis, u=basis.interpolate(u)) * model.scene.tissue.thickness
    expected = np.zeros_like(z).reshape(-1, d)
    expected[at[at >= 0], component[at >= 0]] = full[at >= 0]
    f = vector(model, local_rows(layout, z))
    HyperelasticBody(system.points, system.materials).force(vector(model, local_rows(layout, z)), f)  # type: ignore[arg-type]
    assert close(gather_rows(layout, f.array_r), expected.ravel()) < 1e-13


@pytest.mark.ranks
def test_layers_have_their_materials_and_all_points_stand_on_every_rank() -> None:
    """K(0) = K_ee with three materials, also after with_materials; the gathered points give the same force."""
    model = model_of(
        {}, 1, "neo-hooke", tissue={"layers": LAYERS}, effects={"damping": {"kind": "kelvin-voigt", "beta": 0.1}}
    )
    for one in (model, model.with_materials(lam=33.0)):
        system = one.system
        body = HyperelasticBody(system.points, system.materials)  # type: ignore[arg-type]
        K = body.tangent(vector(one, np.zeros(system.layout.n_local)))
        assert close(gather_matrix(system.layout, K), gather_matrix(system.layout, system.K_ee)) < 1e-14
    layout = model.system.layout
    z = bent(model)
    f = vector(model, z)
    system = model.system
    HyperelasticBody(system.points, system.materials).force(vector(model, z), f)  # type: ignore[arg-type]
    order = np.random.default_rng(0).permutation(layout.n_e)
    whole = whole_points(system.points, layout.comm, order)  # type: ignore[arg-type]
    every = np.concatenate(layout.comm.allgather(z))
    u = PETSc.Vec().createWithArray(every[order].copy(), comm=MPI.COMM_SELF)
    g = u.duplicate()
    HyperelasticBody(whole, system.materials).force(u, g)
    result = np.empty_like(every)
    result[order] = g.array_r
    assert close(result[layout.start : layout.start + layout.n_local], f.array_r) < 1e-13


@pytest.mark.serial
@pytest.mark.parametrize(("changes", "order", "law"), BODIES)
def test_compiled_force_is_numpy_s(changes: dict[str, Any], order: int, law: str) -> None:
    """One pass over the nodes against products with B: rounding of the sums, also where layers and a tail differ."""
    layers = {} if changes is CUBE else {k: {n: x for n, x in v.items() if n != "beta"} for k, v in LAYERS.items()}
    model = model_of(changes, order, law, tissue={"layers": layers})
    body, plain = (HyperelasticBody(model.system.points, model.system.materials) for _ in range(2))  # type: ignore[arg-type]
    if body.kernel is None:
        pytest.skip("no C compiler")
    plain.kernel = None
    z, w = vector(model, bent(model)), vector(model, bent(model, 0.01)[::-1].copy())
    f, g = z.duplicate(), z.duplicate()

    def gaps() -> list[float]:
        ours, numpy = body.start(z), plain.start(z)
        fine = body.step(ours, w, f), plain.step(numpy, w, g)
        assert fine[0] == fine[1] == (plain.J.min() > 0 or law == "stvk")
        pairs = [(ours.H, numpy.H), (ours.j, numpy.j), (body.J, plain.J)]
        pairs += [(f.array_r, g.array_r)] * fine[0] + [(ours.log, numpy.log)] * (law != "stvk")
        return [close(a, b) for a, b in pairs]

    assert max(gaps()) < 1e-13
    w.scale(60.0)  # folds cells
    assert max(gaps()) < 1e-13
    assert plain.J.min() < 0


@pytest.mark.serial
def test_off_has_no_points_and_rotation_is_refused() -> None:
    assert build(make_scene()).system.points is None
    with pytest.raises(ValueError, match="cannot go with effects"):
        make_scene(effects={"rotation": True, "finite_strain": {}})
    with pytest.raises(SceneError, match="nonsense"):
        build("paper_forward", ["effects.finite_strain.law='nonsense'"])


def closed_form(law: str, F: Array, lam: float, mu: float) -> Array:
    """P of one gradient of deformation, from the textbook's inverse."""
    J, turned, E = np.linalg.det(F), np.linalg.inv(F).T, (F.T @ F - np.eye(len(F))) / 2
    if law == "stvk":
        return np.asarray(F @ (2 * mu * E + lam * np.trace(E) * np.eye(len(F))))
    return np.asarray(mu * (F - turned) + lam * (np.log(J) if law == "neo-hooke" else J * (J - 1)) * turned)


@pytest.mark.ranks(order=2)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("changes", "side"), [(FLAT, "y+"), (CUBE, "z+")], ids=["2d", "3d"])
def test_patch_of_an_irregular_mesh_has_one_stress(changes: dict[str, Any], side: str, order: int, law: str) -> None:
    """z = a (X - top) of the last axis is 0 at the hand and affine: one P in every point, no force on inner nodes."""
    model = model_of(changes, order, law, contact={"sides": [side], "box": None})
    space, comm, d = model.space, model.system.layout.comm, model.system.layout.dimension
    size = np.array(model.scene.tissue.size)
    x = space.mesh.mesh.geometry.x
    inside = np.prod(np.sin(np.pi * x[:, :d] / size), axis=1)
    x[:, :d] += 0.08 * (inside * np.sin(7.0 * x[:, :d] @ np.arange(2.0, d + 2)))[:, None] * np.cos(np.arange(d))
    points = make_points(space, model.scene, model.scene.effects.finite_strain)  # type: ignore[arg-type]
    assert points.vol.max(initial=0.0) > 1.2 * points.vol.min(initial=np.inf)  # irregular indeed
    nodes = space.V.tabulate_dof_coordinates()[space.free][:, :d]
    a = np.array([0.3, -0.2, -0.25])[-d:]  # shear, and pressed by a quarter
    z = vector(model, np.outer(nodes[:, -1] - size[-1], a).ravel())
    H, normal = np.zeros((d, d)), np.eye(d)[-1]
    H += np.outer(a, normal)
    materials = model.scene.tissue.material
    P = closed_form(law, np.eye(d) + H, materials.lam, materials.mu)
    body, f = HyperelasticBody(points, model.system.materials), z.duplicate()
    h = body.gradient(z).copy()
    assert np.abs(h - H[:, :, None]).max(initial=0.0) < 1e-13
    assert np.abs(points.laws.stress(h, *body.moduli) - P[:, :, None]).max(initial=0.0) < 1e-12 * np.abs(P).max()
    volume = np.prod(size) * model.scene.tissue.thickness
    inner = np.all((nodes > 1e-9) & (nodes < size - 1e-9), axis=1)
    assert comm.allreduce(int(inner.sum())) > 0
    start, half = body.start(zeros := z.duplicate()), z.copy()
    half.scale(0.5)
    assert zeros.norm() == 0.0

    def check(work: float) -> None:
        forces = f.array_r.reshape(-1, d)
        assert np.abs(forces[inner]).max(initial=0.0) < 1e-12 * f.norm()
        assert z.dot(f) == pytest.approx(work, rel=1e-12)

    body.force(z, f)
    check(volume * float(np.sum(P * H)))
    # the force of a step from rest is that of one stress too, and does the work W
    assert body.step(start, half, f)
    check(comm.allreduce(body.energy(z)))
