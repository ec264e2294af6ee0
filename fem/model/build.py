"""Scene to model: mesh, blocks, materials and effects that the scene names, and the error of its mesh as estimated."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.effects.damping import operator as damping_operator
from softgrasp.fem.effects.gravity import acceleration
from softgrasp.fem.effects.rotation import hand_mass
from softgrasp.fem.errors import SceneError, raise_on_all_ranks, shortened
from softgrasp.fem.material import REST, LayerMaterial, in_words, of_layers
from softgrasp.fem.mesh.make import make_mesh
from softgrasp.fem.mesh.scene_hash import scene_hash, scene_keys
from softgrasp.fem.mesh.tissue_mesh import TissueMesh
from softgrasp.fem.model.assembly import (
    Blocks,
    Discretisation,
    Inventory,
    assemble,
    discretise,
    layer_materials,
    make_points,
)
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.model.memory import box_simplices, check_memory, solver_memory
from softgrasp.fem.model.outputs import Output, make_outputs, output_columns
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.file import load_scene_collective
from softgrasp.fem.scene.materials import lame
from softgrasp.fem.scene.scene import Scene, check_dimension
from softgrasp.fem.scene.table import read_motion
from softgrasp.fem.shown import Card, Shown, listed, percent
from softgrasp.fem.system import BlockSystem, LayerBlocks, coupling, tissue_matrices

if TYPE_CHECKING:
    from softgrasp.fem.energy.layers import LayerEnergy


@dataclass(frozen=True)
class MeshEstimate:
    """Error of the deformation: outputs against the hand, over the largest of them."""

    estimate: float  # largest |delta y| over the run, relative [1]
    bound: float  # relative error that was not exceeded wherever it could be checked [1]
    # estimate of y - y_h at the time steps, zero if by "coarser", (steps + 1, p) [m, rad]; y_h + delta is corrected
    delta: Array = field(repr=False)
    # relative errors of the two lowest frequencies that the run can see, omega_h / omega - 1 [1]
    omega: tuple[float, ...]
    time_error: float  # error of the time steps, relative like ``estimate`` [1]
    shift: float  # largest distance of the ends of the contact zone from ``contact.box`` [m]
    n_e: int  # tissue unknowns of the mesh that was estimated [1]
    finer: int  # tissue unknowns of the mesh that it was compared with [1]
    # finer mesh: "order", the next order on the same cells, or "graded", another mesh, which meets the zone; "coarser":
    # the error is extrapolated from a mesh of fewer cells
    by: str
    tolerance: float | None = None  # tolerance of the scene [1], or None
    passes: int = 0  # number of refinements after the first estimate [1]
    obstacle: str = ""  # reason why the tolerance was not reached, or ""
    offer: tuple[float, int] | None = None  # tolerance and unknowns of a graded mesh that does better, or None
    seconds: float = 0.0  # time of the estimate on the slowest rank [s]

    def corrected(self, outputs: Array) -> Array:
        """Outputs y_h + delta y (steps + 1, p) [m, rad]."""
        return np.asarray(outputs + self.delta)


@dataclass
class Stopwatch:
    """Times of named stages, each that of the slowest rank."""

    comm: MPI.Intracomm  # ranks that are timed
    seconds: dict[str, float] = field(default_factory=dict)  # time of each stage by its name, on the slowest rank [s]

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block between two barriers. Collective."""
        self.comm.Barrier()
        begin = time.perf_counter()
        yield
        elapsed = self.comm.allreduce(time.perf_counter() - begin, MPI.MAX)
        self.seconds[name] = self.seconds.get(name, 0.0) + elapsed


@dataclass(frozen=True, repr=False)
class Model(Shown):
    """The full finite element model of a scene.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]"])
    >>> model.states == 2 * (model.system.layout.n_s + model.system.layout.n_e)
    True
    """

    scene: Scene
    """The validated scene, on every rank."""
    space: Discretisation
    """Mesh, function space, and split of its nodes into contact and free ones."""
    system: BlockSystem
    """Operators M, K, D, T, G of hand and tissue, matrices distributed over the ranks."""
    inventory: Inventory
    """Names of compiled forms and of allocated operators."""
    watch: Stopwatch
    """Time of each stage of building and running, on the slowest rank [s]."""
    accuracy: MeshEstimate | None = None
    """Estimate of the error of the mesh; None where the scene has no tolerance."""

    def card(self) -> Card:
        """Mesh, unknowns, materials, effects and the error of the mesh."""
        layout, scene, error = self.system.layout, self.scene, self.accuracy
        on = [name for name, value in scene.effects if value not in (None, False)]
        estimate = "not estimated here; softgrasp explain and simulate do"
        if error is not None:
            estimate = f"{percent(error.estimate)} of the deformation, estimated"
        rows = (
            ("mesh", f"{layout.dimension}D, P{layout.order}, {self.cells} cells"),
            ("unknowns", f"hand {layout.n_s}, tissue {layout.n_e}, {self.states} states"),
            ("material", in_words(self.system.materials)),
            *([] if self.system.energy is None else [("energy", self.system.energy.in_words())]),
            ("effects", listed(on)),
            ("motion", f"{scene.motion.profile}, {scene.time.steps} steps to {scene.time_end:g} s"),
            ("error of the mesh", estimate),
        )
        return Card(f"Model {scene.name}", rows)

    @property
    def cells(self) -> int:
        """Number of cells of the whole mesh."""
        return int(self.space.mesh.mesh.topology.index_map(self.system.layout.dimension).size_global)

    @property
    def states(self) -> int:
        """Number of first-order states 2n = 2 (n_s + n_e)."""
        return self.system.layout.states

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Outputs y of the scene. Collective."""
        return make_outputs(self.scene, self.system)

    @property
    def output_columns(self) -> Array:
        """C' of all outputs, y = C z + C_s q_s: local rows (n_local, p). Collective."""
        return output_columns(self.outputs, self.system.layout.n_local)

    @property
    def scene_hash(self) -> str:
        """See :func:`softgrasp.fem.mesh.scene_hash.scene_hash`."""
        return scene_hash(self.scene)

    @cached_property
    def scene_keys(self) -> dict[str, Any]:
        """See :func:`softgrasp.fem.mesh.scene_hash.scene_keys`."""
        return scene_keys(self.scene)

    def displacement(self, z: Array, q_s: Array) -> Any:
        """Absolute displacement u = R q_s + (z + T q_s) as a function [m], ghosts updated. Collective.

        For z, local rows (n_local,) [m], and q_s (n_s,) [m, rad]; with ``effects.frame`` z is in the axes of the hand.
        """
        if self.system.frame is not None:
            return import_module("softgrasp.fem.model.turned").turned_displacement(self.space, self.system, z, q_s)
        return self.space.nodal(z + self.system.T @ q_s, self.space.R @ q_s)

    def to_pymor(self) -> Any:
        """The full model as ``pymor.models.iosys.SecondOrderModel``, affine in the material of each layer.

        Parameters are ``mu``, ``lambda`` [Pa], ``rho`` [kg/m^3] and, with damping, ``beta`` [s], one number a layer;
        see :func:`softgrasp.fem.model.pymor.second_order`.

        Raises SoftgraspError: pyMOR is not installed, the program runs on several ranks, or the tissue strains
            finitely.
        """
        return import_module("softgrasp.fem.model.pymor").second_order(self)  # optional, and it knows this class

    def velocity(self, z: Array, v: Array, q_s: Array, v_s: Array) -> Any:
        """Absolute velocity of the nodes as a function [m/s], ghosts updated. Collective.

        Args:
            z: displacement against the hand, local rows (n_local,) [m]; it counts with ``effects.frame`` only.
            v: its rate, local rows (n_local,) [m/s].
            q_s, v_s: displacement and velocity of the hand, (n_s,) each [m, rad; m/s, rad/s].
        """
        if self.system.frame is not None:
            return import_module("softgrasp.fem.model.turned").turned_velocity(self.space, self.system, z, v, q_s, v_s)
        return self.displacement(v, v_s)

    def with_materials(
        self,
        lam: float | None = None,
        mu: float | None = None,
        rho: float | None = None,
        *,
        young: float | None = None,
        poisson: float | None = None,
    ) -> Model:
        """The same mesh with other numbers in every layer: K = mu K_mu + lambda K_lambda, M = rho M_1. Collective.

        Only sums of matrices that are there; nothing is assembled. The error of the mesh is another and is left out.

        Args:
            lam: first Lame parameter [Pa]; None keeps that of each layer.
            mu: shear modulus [Pa]; None keeps that of each layer.
            rho: density [kg/m^3]; None keeps that of each layer.
            young, poisson: Young's modulus [Pa] and Poisson's ratio [1], together, instead of lam and mu.

        Raises SceneError: a value is no number, not positive (lam: not above -2 mu / d), or not finite.
        """
        given = {"lam": lam, "mu": mu, "rho": rho, "young": young, "poisson": poisson}
        for key, value in given.items():
            if value is not None and not isinstance(value, Real):
                raise SceneError(f"{key} = {shortened(repr(value))} must be a number")
        if young is not None or poisson is not None:
            if young is None or poisson is None or lam is not None or mu is not None:
                raise SceneError("young and poisson go together, without lam and mu; give one pair")
            if not (np.isfinite(young) and young > 0 and -1 < poisson < 0.5):
                raise SceneError(f"young = {young}, poisson = {poisson}: young must be > 0, poisson between -1 and 0.5")
            lam, mu = lame(young, poisson)
        changes: dict[str, Any] = {
            key: value for key, value in (("lam", lam), ("mu", mu), ("rho", rho)) if value is not None
        }
        d = self.system.layout.dimension
        rows = [
            replace(m, **{key: x for key, x in changes.items() if key == "rho" or not m.part})
            for m in self.system.materials
        ]
        materials = tuple(rows)
        for m in of_layers(materials):
            if not (np.isfinite([m.lam, m.mu, m.rho]).all() and m.mu > 0 and m.rho > 0 and m.lam + 2 * m.mu / d > 0):
                raise SceneError(
                    f"lambda = {m.lam}, mu = {m.mu}, rho = {m.rho} is no material; mu, rho and lambda + 2 mu / {d} "
                    "must be positive"
                )
        return replace(self, system=self.system.with_materials(materials), accuracy=None)

    def with_parameters(self, **values: float) -> Model:
        """The same mesh with other parameters of an own energy or of own terms, in every layer. Collective.

        Only sums of matrices that are there; nothing is assembled. The error of the mesh is another and is left out.

        Args:
            values: by the names of ``tissue.parameters``.

        Raises SceneError: there is no such parameter, its value is not finite, or the stiffness is not affine in it.
        """
        rows = list(self.system.materials)
        known = sorted({m.part for m in rows if m.part and m.part != REST})
        for key, value in values.items():
            if not isinstance(value, Real) or not np.isfinite(value):
                raise SceneError(f"{key} = {shortened(repr(value))} must be a finite number")
            if key not in known:
                own = self.system.energy
                text = "" if own is None else own.why_not(key)
                has = ", ".join(known) or "none"
                raise SceneError(text or f"the model has no parameter '{key}' that it is affine in; it has {has}")
            rows = [replace(m, mu=float(value)) if m.part == key else m for m in rows]
        if self.scene._terms:
            import_module("softgrasp.fem.model.terms").check_values(self.system.layers, rows)  # few scenes pay for it
        return replace(self, system=self.system.with_materials(tuple(rows)), accuracy=None)


def checked_model(model: object) -> Model:
    """The model as it is.

    Raises SceneError: it is a scene or a name, of which :func:`build` would make a model.
    """
    if isinstance(model, Model):
        return model
    shown = f'"{model}"' if isinstance(model, str) else "scene" if isinstance(model, Scene) else type(model).__name__
    raise SceneError(f"a model is needed; give softgrasp.build({shown}) in place of {shown}")


def _assembled(
    comm: MPI.Intracomm, space: Discretisation, scene: Scene, blocks: Blocks, inventory: Inventory
) -> tuple[tuple[LayerBlocks, ...], tuple[LayerMaterial, ...], LayerEnergy | None]:
    """Blocks and materials of the layers, with an own energy also of its parameters, and that energy. Collective."""
    if scene.tissue.energy is None:
        layers = assemble(space, blocks, inventory)
        return layers, layer_materials(scene, layers), None
    from softgrasp.fem.energy.own import energy_of  # only scenes with an energy of their own pay for it
    from softgrasp.fem.model.energy import energy_blocks

    with raise_on_all_ranks(comm):
        own = energy_of(scene)
    assert own is not None
    layers = assemble(space, blocks, inventory, elastic=False)
    result = energy_blocks(space, scene, own, blocks, layers, layer_materials(scene, layers))
    inventory.operators += [f"K[{each.name}]" for each in result[0]]
    return result


def _with_terms(
    space: Discretisation,
    scene: Scene,
    blocks: Blocks,
    T: Array,
    layers: tuple[LayerBlocks, ...],
    materials: tuple[LayerMaterial, ...],
) -> tuple[tuple[LayerBlocks, ...], tuple[LayerMaterial, ...]]:
    """The same with the rows of own terms. Collective."""
    from softgrasp.fem.model.terms import check_values, term_blocks  # only scenes with terms of their own pay for it

    rows, values = term_blocks(space, scene, blocks, T, of_layers(materials))
    layers, materials = (*layers, *rows), (*materials, *values)
    check_values(layers, materials)
    return layers, materials


def build(
    scene: Scene | str | Path,
    overrides: Sequence[str] = (),
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    *,
    mesh: TissueMesh | None = None,
    run: bool = True,
) -> Model:
    """The model of a scene on its a-priori mesh or another; :mod:`softgrasp.fem.accuracy.adapt` refines. Collective.

    Args:
        scene: a scene, the path of its file, or the name of one that ships.
        overrides: "section.key=value" each, as after ``--set``; for a file or a name.
        mesh: on which; None makes that of the scene.
        run: its steps will be computed, so their tables must fit too.

    Raises:
        SceneError, MeshError: with one sentence that names the key or the file.
        ResourceError: it does not fit into the memory of a node, estimated before anything is allocated; a mesh file
            is estimated when its cells are known.
    """
    if isinstance(scene, str | Path):
        scene = load_scene_collective(comm, scene, overrides)
    elif overrides:
        raise SceneError(f"overrides {list(overrides)} need the file or the name of a scene; change the scene itself")
    watch, inventory = Stopwatch(comm), Inventory()
    boxed = scene.tissue.cells if mesh is None and scene.tissue.refine is None else None
    if boxed:
        check_memory(scene, comm, run, len(boxed), box_simplices(boxed))
    with watch.stage("mesh"):
        if mesh is None and scene.tissue.refine is not None:
            from softgrasp.fem.model.refined import refined_mesh  # only scenes with graded cells pay for it

            mesh = refined_mesh(comm, scene)
        mesh = mesh or make_mesh(comm, scene)
    check_dimension(scene, d := mesh.dimension)  # of a mesh file it was unknown before
    if scene.motion.csv is not None:
        with raise_on_all_ranks(comm):  # here, so that a wrong file ends nothing that takes long
            read_motion(scene, d + scene.effects.rotation * d * (d - 1) // 2)
    if not boxed:
        check_memory(scene, comm, run, d, mesh.mesh.topology.index_map(d).size_global)
    with watch.stage("assembly"):
        space = discretise(mesh, scene)
        blocks = Blocks(space, scene)
        layers, materials, energy = _assembled(comm, space, scene, blocks, inventory)
        layout = space.layout
        T = np.asfortranarray(rigid_modes(layout.nodes, layout.dimension, scene.effects.rotation, layout.reference))
        if scene._terms:
            layers, materials = _with_terms(space, scene, blocks, T, layers, materials)
        M_ee, K_ee = tissue_matrices(layers, materials)
        G, M_rigid = coupling(layers, materials, T)
        inventory.operators += ["M_ee", "K_ee", "T", "G"]
        damping = damping_operator(scene, layers, materials)
        if damping.matrix is not None:
            inventory.operators.append("D_ee")
        points, law = None, scene.effects.finite_strain
        if law is not None:
            points = make_points(space, scene, law, energy)
            inventory.operators.append("B")
        moments = import_module("softgrasp.fem.model.moments") if scene.effects.frame else None  # few scenes pay for it
        system = BlockSystem(
            layout=layout,
            layers=layers,
            materials=materials,
            M_ee=M_ee,
            K_ee=K_ee,
            T=T,
            G=G,
            M_hand=hand_mass(scene, layout.dimension),
            M_rigid=M_rigid,
            damping=damping,
            gravity=acceleration(scene, layout.n_s),
            hand_weight=bool(scene.effects.gravity is not None and scene.effects.gravity.hand_weight),
            two_way=scene.effects.reaction,
            memory=solver_memory(scene, layout.n_e, layout.dimension),
            graded=scene.tissue.refine is not None and scene.tissue.refine.grading != "off",
            points=points,
            energy=energy,
            frame=None if moments is None else moments.frame_integrals(space, scene, inventory),
        )
    return Model(scene, space, system, inventory, watch)
