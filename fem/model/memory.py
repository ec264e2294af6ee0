"""Memory of a model, estimated before anything is allocated, against the free memory of the machine."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError, shortened
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.resources import free_memory, size_text
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.costs import ITERATIVE, SolverName, Work

# Peak of mesh, forms and matrices, those of a step included [byte a cell], by dimension and order, measured on boxes
# of 5e4 to 7e5 simplices; then what each layer adds. With the factor they give 0.8 to 1.04 of what was measured. Order
# 4, which estimates of cubic elements compare with, is extrapolated by the size of the matrix of a cell.
CELL_BYTES = {(2, 1): 1600.0, (2, 2): 9000.0, (2, 3): 25000.0, (3, 1): 2350.0, (3, 2): 31000.0, (3, 3): 150000.0,
              (2, 4): 56000.0, (3, 4): 460000.0}  # fmt: skip
LAYER_BYTES = {(2, 1): 600.0, (2, 2): 3900.0, (2, 3): 10800.0, (3, 1): 900.0, (3, 2): 13000.0, (3, 3): 60000.0,
               (2, 4): 24000.0, (3, 4): 180000.0}  # fmt: skip
# Gradients, tangent and law of finite strain on each rank that stores the whole tissue; cubic ones by points and nodes.
STRAIN_BYTES = {(2, 1): 1650.0, (2, 2): 12000.0, (2, 3): 40000.0, (3, 1): 5200.0, (3, 2): 97000.0, (3, 3): 420000.0}
GIB = 2.0**30


@dataclass(frozen=True)
class Need:
    """Estimated memory [byte]."""

    mesh: float  # mesh, forms and matrices, spread over the ranks
    factor: float  # memory of the factor of a step's matrix, over all ranks [byte]
    tables: float  # memory of the tables of hand, loads and outputs over the steps, on every rank [byte]

    def of(self, share: float, ranks: int) -> float:
        """Memory of ``ranks`` ranks with this share of the tissue [byte]."""
        return share * (self.mesh + self.factor) + ranks * self.tables


def factor_bytes(name: str, n: int, dimension: int, copies: float) -> float:
    """Estimated memory of the Cholesky factor over all ranks [byte]; nested dissection.

    nnz(L) / n = 7.75 log2 n - 44 in 2D and 19.5 n^(1/3) - 85 in 3D, fitted to regular simplex meshes of 1e3 to 4e6
    (2D) and 5e2 to 2e5 (3D) unknowns; 8 byte an entry and 4 an index, of which cholesky has one for d^2 entries.
    """
    if name in ITERATIVE or n < 2:
        return 0.0
    row = 7.75 * np.log2(n) - 44 if dimension == 2 else 19.5 * n ** (1 / 3) - 85
    entry = 8 + (4 / dimension**2 if name == "cholesky" else 4)
    return float(entry * n * np.clip(row, 1, (n + 1) / 2) * copies)


def box_simplices(cells: list[int]) -> int:
    """Triangles or tetrahedra of a structured box."""
    return math.factorial(len(cells)) * math.prod(cells)


def need(scene: Scene, dimension: int, cells: int, ranks: int, run: bool) -> Need:
    """Estimate the memory of a model of ``cells`` triangles or tetrahedra and, if it will ``run``, of its steps."""
    kind, d = (dimension, scene.tissue.order), dimension
    n_e = max(int(_nodes(*kind) * cells * d), 1)
    n_s = d + (d * (d - 1) // 2 if scene.effects.rotation else 0)
    work = steps_of(scene, n_e, d, ranks)
    name = work.solver(scene.time.solver, solver_memory(scene, n_e, d))
    copies = work.copies(name)
    outputs = sum(n_s if o.kind == "hand" else d for o in scene.control.outputs) if scene.control is not None else d
    # times; q, v, a, c, pulls and temporaries of the hand's table; outputs, their sum and their rigid share: measured
    # 194 byte a step for n_s = d = 2
    row = 8.0 * (2 + 7 * n_s + 4 * outputs)
    if scene.effects.frame is not None:  # shares of the momenta, twice while they are summed
        row += 8.0 * 2 * (d + d * d + n_s)
    strain = copies * STRAIN_BYTES.get(kind, 0.0) if scene.effects.finite_strain is not None else 0.0
    return Need(
        mesh=cells * (CELL_BYTES[kind] + len(scene.tissue.layers) * LAYER_BYTES[kind] + strain),
        factor=factor_bytes(name, n_e, d, copies),
        tables=row * scene.time.steps if run else 0.0,
    )


def solver_of(scene: Scene, layout: BlockLayout) -> tuple[SolverName, str]:
    """The solver of the steps of a scene, with the reason in words."""
    return chosen(scene, steps_of(scene, layout.n_e, layout.dimension, layout.comm.size))


def chosen(scene: Scene, work: Work) -> tuple[SolverName, str]:
    """The solver of steps that do so much work, and the reason in words."""
    requested, limit = scene.time.solver, solver_memory(scene, work.n, work.dimension)
    name = work.solver(requested, limit)
    return name, work.reason(requested, limit) + work.price_of_bits(name)


def steps_of(scene: Scene, n: float, dimension: int, ranks: int) -> Work:
    """The solves of the steps of a scene with n unknowns."""
    materials = [scene.tissue.material, *(layer.material for layer in scene.tissue.layers.values())]
    contrast = max(m.lam / m.mu for m in materials)
    time = scene.time
    refine, damped = scene.tissue.refine, scene.effects.damping is not None
    graded = _flat_cells(scene) or (refine is not None and refine.grading != "off")
    order, bits = scene.tissue.order, time.reproducible
    effects = scene.effects
    linear = effects.finite_strain is None and effects.frame is None and not effects.obstacles
    direct = not linear or bool(scene.tissue.layers)  # layers may leave larger errors at the tolerance of stars
    return Work(n, dimension, order, ranks, time.steps, False, contrast, bits, graded, damped, linear, direct)


def _flat_cells(scene: Scene) -> bool:
    """Whether cells of a box have edges of a ratio above 2, or those of another mesh may have, as graded ones do."""
    size, cells = scene.tissue.size, scene.tissue.cells
    if size is None or cells is None:
        return True
    edges = [w / n for w, n in zip(size, cells, strict=True)]
    return max(edges) > 2 * min(edges)


def solver_memory(scene: Scene, n: float, dimension: int) -> float:
    """Memory that a solver may need to be chosen [byte]: what mesh and matrices leave of ``output.memory``, or any.

    With "auto" no machine's memory decides: what does not fit there is refused. No candidate needs over 6 GB on a rank.
    """
    if scene.output.memory == "auto":
        return np.inf
    order = scene.tissue.order
    return scene.output.memory * GIB - CELL_BYTES[dimension, order] * n / dimension / _nodes(dimension, order)


def _nodes(dimension: int, order: int) -> float:
    """Nodes a cell of large regular meshes, p^d / d! [1]."""
    return float(order**dimension) / math.factorial(dimension)


def free_bytes(scene: Scene) -> float:
    """Memory that a run may use on this node [byte]: ``output.memory``, or what is free."""
    return free_memory() if scene.output.memory == "auto" else scene.output.memory * GIB


def check_memory(scene: Scene, comm: MPI.Intracomm, run: bool, dimension: int, cells: int) -> None:
    """Refuse a model or run that does not fit into the memory of some node. Collective.

    Raises ResourceError: on all ranks, with the key, the estimate, what the node has, and what would fit.
    """
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    ranks, free = node.size, node.bcast(free_bytes(scene))
    node.Free()
    estimate = need(scene, dimension, cells, comm.size, run)
    nodes = comm.allgather((estimate.of(ranks / comm.size, ranks) / max(free, 1.0), ranks, free))
    worst, ranks, free = max(nodes)
    if worst <= 1:
        return
    share = ranks / comm.size
    tissue = share * (estimate.mesh + estimate.factor)
    if ranks * estimate.tables > tissue:
        key, given = "time.steps", f"{scene.time.steps}"
        fits = f"time.steps = {_digits(scene.time.steps * max(free - tissue, 0.0) / (ranks * estimate.tables))}"
        parts = "tables of hand, loads and outputs"
    else:
        given, key = _size_key(scene)
        fits = _fitting(scene, comm.size, run, dimension, cells, share, ranks, free)
        allowed = float(f"{0.95 * free / GIB:.2g}")
        other = scene.model_copy(update={"output": scene.output.model_copy(update={"memory": allowed})})
        if need(other, dimension, cells, comm.size, run).of(share, ranks) <= allowed * GIB:
            fits = f"another solver by --set output.memory={allowed:g}, {fits}"
        parts = f"mesh and matrices {size_text(share * estimate.mesh)}"
        if estimate.factor:  # conjugate gradients have none
            parts += f", factor {size_text(share * estimate.factor)}"
    where = f"{ranks} rank{'s' if ranks > 1 else ''} of {comm.size} on one node"
    needs = size_text(estimate.of(share, ranks))
    raise ResourceError(
        f"{key} = {shortened(given)} needs about {needs} ({parts}) for {where}, where {size_text(free)} may be used; "
        f"use about {fits} or less, more nodes, or allow more with --set output.memory=GIB"
    )


def _fitting(
    scene: Scene, size: int, run: bool, dimension: int, cells: int, share: float, ranks: int, free: float
) -> str:
    """Largest mesh that fits, as text: cells along the edges of a box, or of a mesh file in all."""
    box = scene.tissue.cells if _size_key(scene)[1] == "tissue.cells" else None

    def smaller(factor: float) -> list[int]:
        return [max(_digits(factor * n), 1) for n in box or [cells]]

    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        count = box_simplices(smaller(middle)) if box else smaller(middle)[0]
        fits = need(scene, dimension, count, size, run).of(share, ranks) <= free
        low, high = (middle, high) if fits else (low, middle)
    return f"tissue.cells = {smaller(low)}" if box else f"{smaller(low)[0]} of its {cells} cells"


def _size_key(scene: Scene) -> tuple[str, str]:
    """The value and the key that decide how many cells there are."""
    tissue, refine = scene.tissue, scene.tissue.refine
    if refine is not None and refine.tolerance is not None:
        return f"{refine.tolerance:g}", "tissue.refine.tolerance"
    return (f"{tissue.cells}", "tissue.cells") if tissue.cells else (f"'{tissue.mesh}'", "tissue.mesh")


def _digits(value: float) -> int:
    """The first two digits of a number, rounded down."""
    whole = int(value)
    step: int = 10 ** max(len(str(whole)) - 2, 0)
    return whole // step * step
