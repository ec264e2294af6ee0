"""Gates of the effects against numbers computed by hand, and the modes they rest on against SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.effects import EFFECTS, Problem
from softgrasp.fem.effects.damping import operator, ratios
from softgrasp.fem.effects.gate import Gradient, Sag
from softgrasp.fem.effects.gravity import acceleration
from softgrasp.fem.effects.rotation import hand_mass
from softgrasp.fem.errors import SolverError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.build import build
from softgrasp.fem.model.scales import damping_ratios, measure, measure_sag, rigid_inertia
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.modes import lowest_modes

EPS = np.finfo(float).eps


def scene_of(**parts: Any) -> Scene:
    data: dict[str, Any] = {
        "name": "gates",
        "tissue": {"size": [1.0, 2.0], "cells": [3, 6], "material": {"lambda": 50.0, "mu": 50.0, "rho": 1.0}},
        "contact": {"sides": ["left", "right"], "box": [[0.0, 1.5], [1.0, 2.0]]},
        "motion": {"target": [1.0, 0.0], "duration": 2.0},
        "time": {"steps": 10},
    }
    return Scene.model_validate(data | parts)


def problem_of(scene: Scene, **numbers: Any) -> Problem:
    defaults: dict[str, Any] = {
        "dimension": 2,
        "length": 2.0,
        "materials": (LayerMaterial(50.0, 50.0, 1.0),),
        "tissue_mass": 2.0,
        "tissue_inertia": (0.5,),
        "omega": (4.0, 10.0),
        "zeta": (0.0, 0.0),
        "sag": Sag((0.0, -9.81), 0.5, Gradient(0.4, 0.08, 0.005, 0.05)),
        "response": Gradient(0.4, 0.08, 0.005, 0.05),
    }
    return Problem(scene, **(defaults | numbers))


def test_gravity() -> None:
    on = scene_of(effects={"gravity": {"g": [3.0, -4.0]}})
    gate = EFFECTS["gravity"].gate(problem_of(on))
    assert gate.number == 0.08
    assert gate.matters
    assert "sag by 0.5 m, 0.25 of its length 2 m" in gate.sentence
    assert "|grad z| is at most 0.08 in 99 % of the body: the theory holds" in gate.sentence
    weak = Sag((3.0, -4.0), 0.01, Gradient(0.2, 0.009, 0.001, 0.005))
    assert not EFFECTS["gravity"].gate(problem_of(on, sag=weak)).matters, "steep at the edge of the contact zone only"
    steep = Sag((3.0, -4.0), 1.0, Gradient(0.5, 0.3, 0.25, 0.2))
    assert "does not hold, 25 % of the body" in EFFECTS["gravity"].gate(problem_of(on, sag=steep)).sentence
    falling = scene_of(
        effects={"gravity": {"g": [0.0, -1.0], "hand_weight": True}}, motion={"profile": "hold", "drive": "force"}
    )
    gate = EFFECTS["gravity"].gate(problem_of(falling, sag=weak))
    assert gate.matters
    assert "pulls on the hand" in gate.sentence
    off = EFFECTS["gravity"].gate(problem_of(scene_of()))
    assert off.sentence.startswith("Off")
    assert off.proviso == "if its numbers are in SI units"


def test_a_strip_that_bends_sags_as_a_beam(comm: MPI.Intracomm) -> None:
    """Held at one end: rho g L / E is 0.1, but the beam sags 2.9 times its length."""
    L, h, E, nu, rho, g = 0.2, 0.02, 2e4, 0.3, 1e3, 9.81
    strip = {
        "tissue": {"size": [L, h], "cells": [20, 2], "order": 2, "material": {"young": E, "poisson": nu, "rho": rho}},
        "contact": {"sides": ["left"]},
        "motion": {"profile": "hold"},
        "effects": {"gravity": {"g": [0.0, -g]}},
    }
    model = build(scene_of(**strip), comm=comm)
    sag, response = measure_sag(model, np.array([0.0, 3.0]))
    assert response.rms == pytest.approx(sag.gradient.rms * (g + 3.0) / g, rel=1e-9)  # pulled up it weighs more
    bending = E / (1 - nu**2) * h**2 / 12  # plane strain, over the area
    # beam with shear; cross-sections at the hand stay plane, which the beam does not know: (h / L)^2
    expected = rho * g * (L**4 / (8 * bending) + L**2 / (2 * 5 / 6 * E / (2 * (1 + nu))))
    assert sag.largest == pytest.approx(expected, rel=(h / L) ** 2)
    assert sag.largest > 2 * L
    # at the tip nothing but a rotation, whose gradient is skew: sqrt(2) times the slope
    assert sag.gradient.typical == pytest.approx(np.sqrt(2) * rho * g * L**3 / (6 * bending), rel=0.02)  # 5 h of cells
    assert not sag.gradient.linear
    gate = EFFECTS["gravity"].gate(measure(model, np.zeros(0), np.zeros((model.system.layout.n_local, 0)), np.zeros(2)))
    assert gate.number == sag.gradient.typical
    assert rho * g * L / E < 0.1 < gate.number


def test_a_hanging_bar_stretches_as_it_should(comm: MPI.Intracomm) -> None:
    """lambda = 0: z = rho g (L y - y^2 / 2) / E from the top, which P2 holds exactly; gravity off counts as earth's."""
    mu, rho, L, n = 50.0, 0.1, 2.0, 4
    bar = {
        "tissue": {"size": [1.0, L], "cells": [2, n], "order": 2, "material": {"lambda": 0.0, "mu": mu, "rho": rho}},
        "contact": {"sides": ["top"]},
        "motion": {"profile": "hold"},
    }
    sag, _ = measure_sag(build(scene_of(**bar), comm=comm), np.zeros(2))
    assert sag.g == (0.0, -9.81)
    assert sag.largest == pytest.approx(rho * 9.81 * L**2 / (4 * mu), rel=1e-10)  # direct solve
    steps = rho * 9.81 * L * (1 - (np.arange(n) + 0.5) / n) / (2 * mu)  # mean slope in each row of cells
    assert sag.gradient.largest == pytest.approx(steps[0], rel=1e-10)  # as above
    assert sag.gradient.typical == sag.gradient.largest  # a cell is more than one in a hundred
    assert sag.gradient.share == 0.0
    assert sag.gradient.linear


def test_damping() -> None:
    # (0.4/4 + 0.01*4)/2 and (0.4/10 + 0.01*10)/2
    zeta = ratios(0.4, 0.01, np.array([4.0, 10.0]))
    np.testing.assert_allclose(zeta, [0.07, 0.07], rtol=4 * EPS)  # a handful of roundings
    damping = {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01}
    on = problem_of(scene_of(effects={"damping": damping}), zeta=(0.07, 0.07))
    gate = EFFECTS["damping"].gate(on)
    assert gate.number == 0.07
    assert gate.threshold == pytest.approx(0.05 / (4 * 2), rel=4 * EPS)  # a handful of roundings
    assert gate.matters
    assert not EFFECTS["damping"].gate(problem_of(scene_of(effects={"damping": damping}), zeta=(1e-4, 1e-4))).matters
    off = EFFECTS["damping"].gate(problem_of(scene_of()))
    assert off.number == 0.0
    assert "undamped ring-down" in off.sentence
    assert not off.matters
    control = {"outputs": [{"kind": "hand"}]}
    assert EFFECTS["damping"].gate(problem_of(scene_of(control=control))).matters
    unknown = EFFECTS["damping"].gate(problem_of(scene_of(), omega=(), zeta=()))
    assert np.isnan(unknown.number)


def test_reaction() -> None:
    hand = {"mass": 20.0}
    force = {"target": [1.0, 0.0], "drive": "force"}
    moved = EFFECTS["reaction"].gate(problem_of(scene_of(hand=hand)))
    assert moved.number == 0.1
    assert not moved.matters, "a prescribed motion feels no reaction"
    pushed = EFFECTS["reaction"].gate(problem_of(scene_of(hand=hand, motion=force)))
    assert pushed.matters
    assert "9.1 %" in pushed.sentence  # 0.1 / 1.1
    heavy = EFFECTS["reaction"].gate(problem_of(scene_of(hand={"mass": 100.0}, motion=force)))
    assert not heavy.matters


def test_rotation() -> None:
    hand = {"mass": 20.0, "inertia": 0.25}
    turn = {"target": [1.0, 0.0, 0.1]}
    on = {"rotation": True}
    gate = EFFECTS["rotation"].gate(problem_of(scene_of(hand=hand, effects=on, motion=turn)))
    assert gate.number == 2.0  # 0.5 / 0.25
    assert gate.matters
    still = EFFECTS["rotation"].gate(problem_of(scene_of(hand=hand, effects=on, motion={"target": [1.0, 0.0, 0.0]})))
    assert not still.matters
    force = {"target": [1.0, 0.0], "drive": "force"}
    called = EFFECTS["rotation"].gate(problem_of(scene_of(effects={"reaction": True}, motion=force)))
    assert called.number == 0.1, "without inertia the hand is as large as the tissue"
    assert called.matters
    beside = EFFECTS["rotation"].gate(problem_of(scene_of(motion=force)))
    assert beside.matters, "the reaction is off, but called for: with it the tissue turns the hand"
    assert beside.proviso == "together with reaction"
    light = problem_of(scene_of(motion=force, hand={"mass": 100.0, "inertia": 0.25}))
    assert not EFFECTS["rotation"].gate(light).matters, "no reaction that counts, so nothing turns the hand"


def layered_scene(**parts: Any) -> Scene:
    tissue = {
        "size": [1.0, 2.0],
        "cells": [3, 6],
        "material": {"lambda": 50.0, "mu": 50.0, "rho": 1.0},
        "layers": {"soft": {"box": [[0.0, 0.0], [1.0, 1.0]], "material": {"lambda": 50.0, "mu": 50.0, "rho": 3.0}}},
    }
    return scene_of(tissue=tissue, **parts)


@pytest.mark.parametrize("drive", ["motion", "force"])
@pytest.mark.parametrize("control", [None, {"outputs": [{"kind": "hand"}]}])
@pytest.mark.parametrize("effects", [{}, {"reaction": True}, {"rotation": True}, {"reaction": True, "rotation": True}])
@pytest.mark.parametrize("inertia", [0.25, 100.0])
def test_number_and_verdict_do_not_contradict(
    drive: str, control: Any, effects: dict[str, bool], inertia: float
) -> None:
    angle = [0.1] if effects.get("rotation") and inertia > 1 else [0.0] if effects.get("rotation") else []
    motion = {"target": [1.0, 0.0, *angle], "drive": drive}
    scene = layered_scene(hand={"inertia": inertia}, effects=effects, motion=motion, control=control)
    materials = (LayerMaterial(50.0, 50.0, 1.0), LayerMaterial(50.0, 50.0, 3.0))
    for effect in EFFECTS.values():
        gate = effect.gate(problem_of(scene, materials=materials))
        assert ((gate.number > gate.threshold) == gate.matters) == (not gate.condition), gate
        assert gate.condition in gate.comparison
        assert f"threshold {gate.threshold:.3g}" in gate.comparison
    assert (
        "not computed (counts as it is set)" in EFFECTS["damping"].gate(problem_of(scene, omega=(), zeta=())).comparison
    )


def test_layers() -> None:
    scene = layered_scene()
    stiff, soft = LayerMaterial(50.0, 50.0, 1.0), LayerMaterial(20.0, 20.0, 1.0)
    gate = EFFECTS["layers"].gate(problem_of(scene, materials=(stiff, soft)))
    assert gate.number == pytest.approx(2.5, rel=4 * EPS)  # E is proportional; a handful of roundings
    assert gate.matters
    assert not EFFECTS["layers"].gate(problem_of(scene, materials=(stiff, stiff))).matters
    dense = EFFECTS["layers"].gate(problem_of(scene, materials=(stiff, LayerMaterial(50.0, 50.0, 3.0))))
    assert dense.matters
    assert "density" in dense.sentence
    assert not EFFECTS["layers"].gate(problem_of(scene_of())).matters


def test_operators_named_only_when_on() -> None:
    bare = scene_of()
    assert all(effect.operators(bare) == () and not effect.active(bare) for effect in EFFECTS.values())
    full = layered_scene(
        hand={"inertia": 1.0},
        effects={
            "gravity": {"g": [0.0, -1.0]},
            "damping": {"kind": "kelvin-voigt", "beta": 0.1},
            "reaction": True,
            "rotation": True,
            "frame": "hand",
        },
        motion={"target": [0.0, 0.0, 0.1], "drive": "force"},
    )
    linear = {name: effect for name, effect in EFFECTS.items() if name not in ("finite_strain", "obstacles")}
    assert all(effect.active(full) for effect in linear.values())
    counts = {name: len(effect.operators(full)) for name, effect in linear.items()}
    assert counts == {"gravity": 0, "damping": 0, "reaction": 2, "rotation": 3, "frame": 1, "layers": 3}
    assert all(effect.term and effect.cost for effect in EFFECTS.values())


@pytest.mark.parametrize("d", [2, 3])
def test_inertia_of_a_box(comm: MPI.Intracomm, d: int) -> None:
    size = [1.0, 2.0, 0.5][:d]
    tissue = {"size": size, "cells": [2] * d, "material": {"lambda": 50.0, "mu": 50.0, "rho": 3.0}}
    if d == 2:
        tissue["thickness"] = 0.5
    scene = scene_of(
        tissue=tissue, contact={"sides": ["left"]}, hand={"reference": [0.0] * d}, motion={"profile": "hold"}
    )
    mass, inertia = rigid_inertia(build(scene, comm=comm))
    # corner of a box: J_z = m (a^2 + b^2) / 3
    a, b, c = 1.0, 2.0, 0.5
    expected = [(a * a + b * b)] if d == 2 else [b * b + c * c, a * a + c * c, a * a + b * b]
    assert mass == pytest.approx(3.0, rel=1e-13)  # sums over a few dozen cells
    np.testing.assert_allclose(inertia, np.array(expected) * 3.0 / 3, rtol=1e-13)  # as above


def test_units_build_what_the_model_has(comm: MPI.Intracomm) -> None:
    scene = scene_of(
        hand={"mass": 3.0, "inertia": 0.25},
        effects={
            "gravity": {"g": [1.0, -4.0]},
            "damping": {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01},
            "rotation": True,
        },
        motion={"target": [1.0, 0.0, 0.1]},
    )
    system = build(scene, comm=comm).system
    np.testing.assert_array_equal(system.gravity, acceleration(scene, system.layout.n_s))
    np.testing.assert_array_equal(system.M_hand, hand_mass(scene, 2))
    assert system.damping == operator(scene, system.layers, system.materials)
    omega, Phi = lowest_modes(system, 3)
    problem = measure(build(scene, comm=comm), omega, Phi, np.zeros(3))
    assert problem.length == 2.0
    np.testing.assert_array_equal(problem.zeta, ratios(0.4, 0.01, omega))
    # rotation about the reference is in M_rigid too, from the mass matrix
    np.testing.assert_allclose(problem.tissue_inertia, system.M_rigid[2, 2], rtol=1e-12)  # two sums over cells


def gathered(A: PETSc.Mat) -> Array:
    """Dense copy of a distributed matrix on every rank."""
    n = A.getSize()[1]
    begin, end = A.getOwnershipRange()
    indptr, indices, values = A.getValuesCSR()
    local = np.zeros((end - begin, n))
    for i in range(end - begin):
        local[i, indices[indptr[i] : indptr[i + 1]]] = values[indptr[i] : indptr[i + 1]]
    return np.vstack(A.comm.tompi4py().allgather(local))


@pytest.mark.parametrize("order", [1, 2])
def test_modes_against_dense(comm: MPI.Intracomm, order: int) -> None:
    tissue = {
        "size": [1.0, 2.0],
        "cells": [3, 6],
        "order": order,
        "material": {"lambda": 50.0, "mu": 50.0, "rho": 2.0},
    }
    system = build(scene_of(tissue=tissue), comm=comm).system
    before = dict(PETSc.Options().getAll())
    omega, Phi = lowest_modes(system, 5)
    assert dict(PETSc.Options().getAll()) == before
    K, M = gathered(system.K_ee), gathered(system.M_ee)
    squares, modes = scipy.linalg.eigh(K, M)
    np.testing.assert_allclose(omega**2, squares[:5], rtol=1e-9)  # eigh loses eps |K| / omega_1^2, about 1e-12
    Phi = np.vstack(comm.allgather(Phi))
    np.testing.assert_allclose(Phi.T @ M @ Phi, np.eye(5), atol=1e-8)  # eigenvectors: tolerance over relative gap
    overlap = np.abs(np.einsum("ik,ik->k", modes[:, :5], M @ Phi))
    np.testing.assert_allclose(overlap, 1.0, atol=1e-8)  # as above


def test_modes_on_a_3d_box(comm: MPI.Intracomm) -> None:
    tissue = {"size": [1.0, 1.0, 1.0], "cells": [3, 3, 3], "material": {"lambda": 50.0, "mu": 50.0, "rho": 2.0}}
    scene = scene_of(tissue=tissue, contact={"sides": ["bottom"]}, motion={"profile": "hold"})
    system = build(scene, comm=comm).system
    omega, _ = lowest_modes(system, 6)
    squares = scipy.linalg.eigh(gathered(system.K_ee), gathered(system.M_ee), eigvals_only=True)
    np.testing.assert_allclose(omega**2, squares[:6], rtol=1e-9)  # eigh loses eps |K| / omega_1^2, about 1e-12


@pytest.mark.ranks
def test_modes_are_the_same_on_one_rank(comm: MPI.Intracomm) -> None:
    """Signs too: compare at the node that lies lowest on the left."""

    def corner(c: MPI.Intracomm) -> Array:
        system = build(scene_of(), comm=c).system
        _, Phi = lowest_modes(system, 4)
        owner, dof, _ = system.layout.nearest_node(np.zeros(2))
        return np.asarray(c.bcast(Phi[dof : dof + 2] if c.rank == owner else None, owner))

    np.testing.assert_allclose(corner(comm), corner(MPI.COMM_SELF), atol=1e-7)  # eigenvectors: tolerance over gap


def test_multiple_modes_are_all_found(comm: MPI.Intracomm) -> None:
    """K = diag(1, 1, 1, 2, 3 ..), M = I: three copies that one Krylov space sees as one."""
    from types import SimpleNamespace

    values = np.append([1.0, 1.0], np.arange(1.0, 39.0))
    K = PETSc.Mat().createAIJ((40, 40), nnz=1, comm=comm)
    M = PETSc.Mat().createAIJ((40, 40), nnz=1, comm=comm)
    begin, end = K.getOwnershipRange()
    for i in range(begin, end):
        K.setValue(i, i, values[i])
        M.setValue(i, i, 1.0)
    K.assemble()
    M.assemble()
    nodes = np.arange(begin, end, dtype=float)[:, None]
    shape = {"n_e": 40, "n_local": end - begin, "dimension": 1, "order": 1}
    layout = SimpleNamespace(comm=comm, nodes=nodes, reference=np.zeros(1), **shape)
    rest = {"kept": {}, "materials": (), "points": None, "graded": False, "memory": np.inf}
    system: Any = SimpleNamespace(layout=layout, K_ee=K, M_ee=M, **rest)
    omega, Phi = lowest_modes(system, 4)
    np.testing.assert_allclose(omega, np.sqrt([1.0, 1.0, 1.0, 2.0]), rtol=1e-8)  # RESIDUAL of the check
    Phi = np.vstack(comm.allgather(Phi))
    np.testing.assert_allclose(Phi.T @ Phi, np.eye(4), atol=1e-7)  # deflation to the solver's tolerance
    K.destroy()
    M.destroy()


def test_modes_refuse(comm: MPI.Intracomm) -> None:
    system = build(scene_of(), comm=comm).system
    with pytest.raises(SolverError, match="0 modes are requested"):
        lowest_modes(system, 0)
    with pytest.raises(SolverError, match="between 1 and n_e"):
        lowest_modes(system, system.layout.n_e + 1)


def test_layered_damping_ratios(comm: MPI.Intracomm) -> None:
    """A matrix beta K must give the ratios of the number beta."""
    from dataclasses import replace

    system = build(scene_of(effects={"damping": {"kind": "kelvin-voigt", "beta": 0.02}}), comm=comm).system
    omega, Phi = lowest_modes(system, 3)
    D = system.K_ee.copy()
    D.scale(0.02)
    other = replace(system, damping=replace(system.damping, beta=0.0, matrix=D))
    np.testing.assert_allclose(damping_ratios(other, omega, Phi), 0.02 * omega / 2, rtol=1e-8)  # RESIDUAL of the modes
    D.destroy()
