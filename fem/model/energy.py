"""An own energy in the blocks of hand and tissue: its tangent at rest as a sum over parameters, and its points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import basix.ufl
import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI

from softgrasp.fem.energy.law import EnergyLaw
from softgrasp.fem.energy.layers import MODULI, LayerEnergy
from softgrasp.fem.energy.own import OwnEnergy
from softgrasp.fem.energy.rest import SAME, Affine, affine_parameters, check_solid, ordered
from softgrasp.fem.energy.translate import PLACE
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.material import REST, LayerMaterial
from softgrasp.fem.model.assembly import Blocks, Discretisation, quadrature
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.system import Component, LayerBlocks

SAMPLES = 64  # places on a rank that decide which parameters are affine, where the energy depends on the place


def layer_values(scene: Scene, name: str) -> dict[str, float]:
    """Parameters of a layer: those of the tissue, then its own, and mu and lam of its material."""
    tissue = scene.tissue
    layer = tissue.layers.get(name)
    m = tissue.material if layer is None else layer.material
    return {"mu": m.mu, "lam": m.lam, **tissue.parameters, **({} if layer is None else layer.parameters)}


class RestStiffness:
    """The matrices of moduli, constant or given in every point, with one compiled form."""

    def __init__(self, space: Discretisation, varying: bool) -> None:
        domain, d = space.mesh.mesh, space.mesh.dimension
        self.space, self.varying = space, varying
        at, _, degree = quadrature(space)
        u, v = ufl.TrialFunction(space.V), ufl.TestFunction(space.V)
        if varying:
            cell = space.V.element.basix_element.cell_type.name
            element = basix.ufl.quadrature_element(cell, value_shape=(d, d, d, d), degree=degree)
            self.moduli: Any = dolfinx.fem.Function(dolfinx.fem.functionspace(domain, element))
        else:
            self.moduli = dolfinx.fem.Constant(domain, np.zeros((d, d, d, d)))
        i, j, k, m = ufl.indices(4)
        self.integrand = self.moduli[i, j, k, m] * ufl.grad(u)[k, m] * ufl.grad(v)[i, j]
        self.X = (space.mesh.vertices[:, :1] + at @ space.mesh.edges).reshape(-1, d)
        self.layer = np.repeat(space.layer, len(at))
        self.metadata = {"quadrature_degree": degree} if varying else {}

    def set(self, A: Array, layer: int) -> None:
        """Moduli (d, d, d, d) of a layer, or (d, d, d, d, points) in its points on this rank."""
        if not self.varying:
            self.moduli.value[:] = A
            return
        owned, size = self.space.mesh.owned, int(np.prod(A.shape[:4]))
        dofs = self.moduli.function_space.dofmap.list[:owned].ravel()
        values = self.moduli.x.array.reshape(-1, size)
        values[dofs[self.layer == layer]] = A.reshape(size, -1).T

    def form(self, dx: Any) -> Any:
        """The bilinear form, whose moduli are read when it is assembled."""
        return self.integrand * dx(metadata=self.metadata)


def energy_blocks(
    space: Discretisation,
    scene: Scene,
    energy: OwnEnergy,
    blocks: Blocks,
    layers: tuple[LayerBlocks, ...],
    materials: tuple[LayerMaterial, ...],
) -> tuple[tuple[LayerBlocks, ...], tuple[LayerMaterial, ...], LayerEnergy]:
    """The layers with the stiffness of an energy at rest, then a row for each further part of it. Collective.

    Args:
        blocks: assembles the forms.
        layers: with masses; their stiffness is not used.
        materials: of the layers.

    Raises SceneError: the energy has a stress at rest, a strain that costs nothing, or cannot be translated.
    """
    d, comm = space.layout.dimension, space.layout.comm
    with raise_on_all_ranks(comm):
        law = energy.law(scene, d)
    values = tuple(layer_values(scene, name) for name in space.layers)
    stiffness = RestStiffness(space, any(key in PLACE for key in law.inputs))
    affine = _checked(law, values, stiffness, space.layers)
    zero = _zero(layers[0].M_1)
    result, extra = list[LayerBlocks](), list[LayerBlocks]()
    rows, places = [*materials], dict[tuple[int, str], int]()
    reasons: dict[str, None] = {}
    for i, own in enumerate(layers):
        at = _inputs(law, values[i], stiffness, i)
        parts = {key: law.at_rest(at, key) for key in affine.parameters}
        remainder = law.at_rest(at) - sum(values[i][key] * A for key, A in parts.items())
        largest = comm.allreduce(float(np.abs(law.at_rest(at)).max(initial=0.0)), MPI.MAX)
        has_rest = comm.allreduce(float(np.abs(remainder).max(initial=0.0)), MPI.MAX) > SAME * largest

        def block(A: Array, i: int = i) -> Component:
            stiffness.set(A, i)
            return blocks(stiffness.form, i)

        hooke = {key: block(parts[key]) if key in parts else zero for key in MODULI}
        result.append(replace(own, K_mu=hooke["mu"], K_lambda=hooke["lam"]))
        rows[i] = replace(materials[i], fixed=tuple((key, values[i][key]) for key in affine.other))
        nothing = np.zeros((d,) * 4 + ((1,) if stiffness.varying else ()))
        if not comm.allreduce(ordered(parts.get("lam", nothing), d / 2 * parts.get("mu", nothing)), MPI.LAND):
            reasons["lambda and mu do not enter its tangent as they enter Hooke's law"] = None
        terms = [(key, A, values[i][key]) for key, A in parts.items() if key not in MODULI]
        if has_rest:
            terms.append((REST, remainder, 1.0))
        for key, A, value in terms:
            if not comm.allreduce(value > 0 and ordered(A, A), MPI.LAND):
                reasons[f"its part of {key} is not positive"] = None
            places[i, key] = len(layers) + len(extra)
            extra.append(LayerBlocks(f"{own.name}.{key}", block(A), zero, zero))
            rows.append(LayerMaterial(0.0, value, rows[i].rho, rows[i].beta, key))
    known = LayerEnergy(law, space.layers, values, affine, places, next(iter(reasons), ""))
    return (*result, *extra), tuple(rows), known


def _inputs(law: EnergyLaw, values: dict[str, float], stiffness: RestStiffness, layer: int) -> dict[str, Array]:
    """Parameters of a layer as numbers, and the places of its points on this rank if the energy depends on them."""
    own = {key: np.array(values[key]) for key in law.parameters}
    if stiffness.varying:
        X = stiffness.X[stiffness.layer == layer]
        own |= {key: np.ascontiguousarray(X[:, PLACE.index(key)]) for key in law.inputs if key in PLACE}
    return own


def _checked(
    law: EnergyLaw, values: tuple[dict[str, float], ...], stiffness: RestStiffness, names: tuple[str, ...]
) -> Affine:
    """Affine parameters of all layers, on all ranks, of an energy that is one of a solid. Collective."""
    comm, mine = stiffness.space.layout.comm, []
    with raise_on_all_ranks(comm):
        for i, name in enumerate(names):
            at = _inputs(law, values[i], stiffness, i)
            count = int((stiffness.layer == i).sum())
            if stiffness.varying and not count:
                continue
            check_solid(law, at, f"layer {name}" if len(names) > 1 else "the tissue")
            few = {key: x[:: max(count // SAMPLES, 1)] if x.ndim else x for key, x in at.items()}
            mine.append(affine_parameters(law, few))
    every = [each for part in comm.allgather(mine) for each in part]
    other: dict[str, str] = {}
    for each in every:
        other |= {key: why for key, why in each.other.items() if key not in other}
    inert = tuple(key for key in law.parameters if all(key in each.inert for each in every))
    return Affine(tuple(key for key in law.parameters if key not in other and key not in inert), inert, other)


def _zero(like: Component) -> Component:
    """A component of zeros with the pattern of another. Collective."""
    ee = like.ee.duplicate(copy=False)
    ee.zeroEntries()
    return Component(ee, np.zeros_like(like.es), np.zeros_like(like.ss))
