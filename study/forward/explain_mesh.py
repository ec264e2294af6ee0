"""What the mesh of a scene leaves to be wrong, before any run: singular ends, expected order, size of the error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from softgrasp.fem.mesh.singular import expected_order
from softgrasp.fem.model.refined import by_lines, scene_ends
from softgrasp.study.forward.accuracy import judge, percent

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

WORTH, MOST = 4.0, 25_000  # [s] predicted, and unknowns: a dearer estimate is left to simulate --certify
LARGE = 200_000  # cells beyond which rank 0 does not look for the ends


@dataclass(frozen=True)
class EndReport:
    """Singular ends of one kind: how many points (2D) or edges (3D), and the smallest exponent alpha [1]."""

    kind: str
    count: int
    alpha: float


@dataclass(frozen=True)
class MeshReport:
    """What is known of the mesh's error before a run."""

    ends: tuple[EndReport, ...]  # singular ends by kind and exponent, the strongest first
    order: float  # expected order of the outputs in n_e^(1/d) d/2, that is in the cell size h on even meshes [1]
    graded: bool  # whether cells shrink towards the ends
    first: bool  # whether a run may refine this mesh further
    # estimate, bound: relative error of the deformation [1]; None where the estimate takes long
    estimate: float | None
    bound: float | None
    time_error: float | None  # that of the time steps [1]
    shift: float | None  # of the ends of the zone against contact.box [m]


def mesh_report(model: Model) -> MeshReport:
    """Look for singular ends and estimate the error. Collective."""
    comm, scene, tissue = model.system.layout.comm, model.scene, model.space.mesh
    refine = scene.tissue.refine
    small = tissue.mesh.topology.index_map(tissue.dimension).size_global <= LARGE
    ends = scene_ends(comm, tissue, scene) if small else None
    reports: dict[tuple[str, float], int] = {}
    for kind, alpha in zip(ends.kind, ends.alpha, strict=True) if ends is not None else ():
        key = (kind, round(float(alpha), 3))
        reports[key] = reports.get(key, 0) + 1
    kinds = tuple(EndReport(k, n, a) for (k, a), n in sorted(reports.items(), key=lambda item: item[0][1]))
    graded = refine is not None and refine.grading != "off"
    edges = graded and tissue.dimension == 3 and not by_lines(scene)
    order = 2.0 * scene.tissue.order if ends is None else expected_order(ends, scene.tissue.order, graded, edges)
    error = judge(model, WORTH if model.system.layout.n_e <= MOST else 0.0, False)[0]
    values = (None,) * 4 if error is None else (error.estimate, error.bound, error.time_error, error.shift)
    first = refine is not None and refine.tolerance is not None and refine.passes > 0
    return MeshReport(kinds, order, graded, first, *values)


def mesh_lines(report: MeshReport, dimension: int) -> list[str]:
    """The report in sentences."""
    place = "point" if dimension == 2 else "edge"
    lines = [
        f"At {e.count} {place}{'s' * (e.count > 1)} of kind '{e.kind}' the displacement grows like r^{e.alpha:.3g}."
        for e in report.ends[:6]
    ]
    if len(report.ends) > len(lines):
        lines.append(f"{len(report.ends) - len(lines)} more kinds of ends have larger exponents.")
    if report.graded:
        lines.append(f"The cells are graded: outputs converge with the order {report.order:g} in n_e^(1/{dimension}).")
    elif report.ends:
        lines.append(
            f"The cells are even: outputs converge with the order {report.order:.2g} in h, whatever tissue.order is."
        )
    if report.first:
        lines.append("This is the first mesh: simulate may refine it further, to meet tissue.refine.tolerance.")
    if report.estimate is not None and report.bound is not None and report.time_error is not None:
        lines.append(
            f"The deformation is about {percent(report.estimate)} off on this mesh (bound {percent(report.bound)}) and "
            f"about {percent(report.time_error)} by the time step."
        )
    else:
        lines.append(
            "The error of the mesh is not estimated here, as that takes some time; simulate --certify does it."
        )
    return lines
