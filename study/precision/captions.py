"""Texts of the page of ``softgrasp study``: captions of the figures, and what points are compared with."""

from __future__ import annotations

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.result import LoopReference, Question, ReducedReference, RiccatiReference

PAPER_ARE, PAPER_SMALL, PAPER_N = 84.53, 0.053, 8  # [s], [s]: the paper, section 4.2, 2n = 880
CAPTIONS = {
    "forward": (
        "Relative error of the deformation, the outputs against the hand over the run, against the time of a whole run "
        "(mesh, assembly, factor, steps). In the grey band the error of the reference is the larger one. "
        "Along a thin line the mesh stays and the steps grow; open marks: even meshes. Right: error against the "
        "unknowns, with the order in n_e^(1/d) and in brackets that of the theory, 2 alpha at the singular ends on "
        "even meshes; change through the time step on every mesh."
    ),
    "reduced": (
        "Relative error of the deformation, the outputs against the hand, against the full run on the same mesh and "
        "steps. Left: time of one reduced run "
        "once the model is there. Right: with everything before it. Open marks: the hand is part of the basis. "
        "Unstable models are left out."
    ),
    "bases": "What a basis leaves of the snapshots against the time to make it; open marks miss it.",
    "budget": "Time of single steps against the error of the deformation, with the budget.",
    "riccati": (
        "Left: relative error of the gain, Frobenius norm in the coordinates of the paper, against the tightest "
        "solution of another method. Right: true residual, recomputed from the factor. Along a line the tolerance "
        "falls. Galerkin bounds the change of its gain instead of the residual; the dense solver has no tolerance."
    ),
    "reduced_riccati": (
        "Gains of the reduced equations on the full plant: error of the gain and excess cost J(K^)/J(K) - 1 from the "
        "scene's start, against N and against the time of the reduced equation alone. Marks on the upper edge: error "
        "above 1; crosses: the full closed loop is not stable, or not certified to be."
    ),
    "loop": (
        "Left: largest error of the deformation, the outputs against the hand, against the optimal loop without any "
        "time step, over its largest deformation; along a line the step falls. Solid: feedback inside the midpoint "
        "rule; dashed: sampled at every step and held; open marks: the reduced plant instead of the full one. Upper "
        "right: error against the same gain without time step. Steps longer than a period of the tissue do not resolve "
        "what the start excites. Lower right: seconds of a step, range over all steps and median."
    ),
}


def paper_of(scene: Scene) -> str:
    """Which scene of the paper this is, so that its own numbers may stand beside ours: forward, control, or neither."""
    if scene.name == "paper_forward" and scene.tissue.cells == [15, 30] and scene.time.steps == 600:
        return "forward"
    return "control" if scene.name.startswith("paper_lqr") and scene.tissue.cells == [10, 20] else ""


def reference_text(question: Question, paper: bool) -> str:
    """What the points of a question about feedback are compared with, and the paper's numbers.

    Args:
        question: answered.
        paper: the scene is the paper's.
    """
    match question.reference:
        case RiccatiReference() as r:
            apart = "no second method converged, so that its own error is not known"
            if r.error is not None:
                apart = f"their gains differ by {r.error:.1e}, which is the estimated error of both"
            text = f"Reference: {' and '.join(r.names)}; {apart}. No method is compared with itself."
            return text + (f" The paper: {PAPER_ARE} s, 2n = 880, on its own machine." if paper else "")
        case ReducedReference() as r:
            text = f"Reference: the gain by {r.method}, with the residual {r.residual:.1e}"
            if r.error is not None:
                text += f"; the tightest solution of another method differs by {r.error:.1e}"
            text += f". The optimal cost from the scene's start is {r.optimal:.6g}."
            theirs = f" The paper: {1e3 * PAPER_SMALL:.0f} ms at N = {PAPER_N} with the POD of P, on its own machine."
            return text + (theirs if paper else "")
        case LoopReference() as r:
            own = f"all {r.modes} modes, exact but for rounding"
            if not r.complete:
                own = f"the {r.modes} lowest modes; with half of them the outputs change by {r.error:.1e}"
            text = f"Reference: the optimal loop by the matrix exponential on {own}."
            return f"{text} Limits and delay of the scene are left out; held means one sample a step."
    return ""
