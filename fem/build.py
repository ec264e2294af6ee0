"""Scene to model: mesh, blocks, materials and the effects the scene names."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from fem.assembly import Discretisation, Inventory, assemble, discretise
from fem.contact import rigid_modes
from fem.geometry import make_mesh
from fem.petsc import Array
from fem.system import (
    BlockSystem,
    Damping,
    LayerBlocks,
    LayerMaterial,
    coupling,
    layered_viscosity,
    tissue_matrices,
)

if TYPE_CHECKING:
    from fem.scene import Scene


@dataclass
class Stopwatch:
    """Seconds of named stages; the slowest rank counts."""

    comm: MPI.Intracomm
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block between two barriers. Collective."""
        self.comm.Barrier()
        begin = time.perf_counter()
        yield
        elapsed = self.comm.allreduce(time.perf_counter() - begin, MPI.MAX)
        self.seconds[name] = self.seconds.get(name, 0.0) + elapsed


@dataclass(frozen=True)
class Model:
    """A scene made ready to run.

    Attributes:
        scene: the validated scene.
        space: mesh, function space and block dof maps.
        system: the operators.
        inventory: compiled forms and allocated operators.
        watch: seconds of mesh and assembly.
    """

    scene: Scene
    space: Discretisation
    system: BlockSystem
    inventory: Inventory
    watch: Stopwatch


def layer_materials(scene: Scene, layers: tuple[LayerBlocks, ...]) -> tuple[LayerMaterial, ...]:
    """Material and Kelvin-Voigt time of each layer; cells of no layer carry tissue.material. Not collective."""
    damping = scene.effects.damping
    beta = damping.beta if damping is not None else 0.0
    result = []
    for blocks in layers:
        layer = scene.tissue.layers.get(blocks.name)
        m = scene.tissue.material if layer is None else layer.material
        own = None if layer is None or damping is None else layer.beta
        result.append(LayerMaterial(m.lam, m.mu, m.rho, beta if own is None else own))
    return tuple(result)


def hand_mass(scene: Scene, d: int) -> Array:
    """M_hand = blkdiag(m I, inertia) [kg, kg m^2]. Not collective."""
    mass = scene.hand.mass * np.eye(d)
    if not scene.effects.rotation:
        return mass
    inertia = np.atleast_1d(np.asarray(scene.hand.inertia, dtype=float))
    if d == 3 and inertia.size == 1:
        inertia = np.repeat(inertia, 3)
    n = len(inertia)
    return np.block([[mass, np.zeros((d, n))], [np.zeros((n, d)), np.diag(inertia)]])


def build(scene: Scene, comm: MPI.Intracomm) -> Model:
    """Mesh, assemble and couple. Collective.

    Raises:
        SceneError, MeshError: with one sentence that names the key or the file.
    """
    watch, inventory = Stopwatch(comm), Inventory()
    with watch.stage("mesh"):
        mesh = make_mesh(comm, scene)
    with watch.stage("assembly"):
        space = discretise(mesh, scene)
        layers = assemble(space, scene, inventory)
        materials = layer_materials(scene, layers)
        M_ee, K_ee = tissue_matrices(layers, materials)
        inventory.operators += ["M_ee", "K_ee"]
        layout = space.layout
        T = np.asfortranarray(rigid_modes(layout.nodes, layout.dimension, scene.effects.rotation, layout.reference))
        G, M_rigid = coupling(layers, materials, T)
        inventory.operators += ["T", "G"]
        wanted = scene.effects.damping
        damping = Damping()
        if wanted is not None:
            matrix = layered_viscosity(layers, materials)
            damping = Damping(
                alpha=wanted.alpha,
                beta=materials[0].beta if matrix is None else 0.0,
                in_space=wanted.drag == "space",
                matrix=matrix,
            )
            if matrix is not None:
                inventory.operators.append("D_ee")
        gravity = None
        if scene.effects.gravity is not None:
            gravity = np.zeros(layout.n_s)
            gravity[: layout.dimension] = scene.effects.gravity.g
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
            gravity=gravity,
            hand_weight=bool(scene.effects.gravity is not None and scene.effects.gravity.hand_weight),
            two_way=scene.effects.reaction,
        )
    return Model(scene, space, system, inventory, watch)
