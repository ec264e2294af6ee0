"""Scene to model: mesh, blocks, materials and the effects the scene names."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from softgrasp.fem.effects.damping import operator as damping_operator
from softgrasp.fem.effects.gravity import acceleration
from softgrasp.fem.effects.rotation import hand_mass
from softgrasp.fem.mesh.make import TissueMesh, make_mesh
from softgrasp.fem.model.assembly import Discretisation, Inventory, assemble, discretise
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.system import (
    BlockSystem,
    LayerBlocks,
    LayerMaterial,
    coupling,
    tissue_matrices,
)

if TYPE_CHECKING:
    from softgrasp.fem.model.mesh_estimate import MeshEstimate
    from softgrasp.fem.scene.scene import Scene


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
        accuracy: estimate of the error of the mesh, where the scene has a tolerance.
    """

    scene: Scene
    space: Discretisation
    system: BlockSystem
    inventory: Inventory
    watch: Stopwatch
    accuracy: MeshEstimate | None = None


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


def _scene_mesh(comm: MPI.Intracomm, scene: Scene) -> TissueMesh:
    if scene.tissue.refine is None:
        return make_mesh(comm, scene)
    from softgrasp.fem.model.refined import refined_mesh  # only scenes with graded cells pay for it

    return refined_mesh(comm, scene)


def build(scene: Scene, comm: MPI.Intracomm, mesh: TissueMesh | None = None) -> Model:
    """Mesh, assemble and couple. Collective.

    Args:
        scene: the scene.
        comm: communicator.
        mesh: on which; None makes that of the scene.

    Raises:
        SceneError, MeshError: with one sentence that names the key or the file.
    """
    watch, inventory = Stopwatch(comm), Inventory()
    with watch.stage("mesh"):
        mesh = mesh or _scene_mesh(comm, scene)
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
        damping = damping_operator(scene, layers, materials)
        if damping.matrix is not None:
            inventory.operators.append("D_ee")
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
        )
    return Model(scene, space, system, inventory, watch)
