"""The equation of a scene with exactly its terms, as text.

Two forms of one equation: the paper's blocks in q = [q_s; q_e], and the one that is stepped, in the displacement
z = q_e - T q_s against the rigid motion of the hand.
"""

from __future__ import annotations

from dataclasses import dataclass

from softgrasp.fem.effects.catalog import layered
from softgrasp.fem.scene.scene import Scene

Rows = tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...]


@dataclass(frozen=True)
class Equation:
    """The equation of one scene, each row a left and a right side."""

    blocks: Rows  # rows of the paper's block system in q_s, q_e, as (name, left terms, right terms)
    stepped: Rows  # the same in z, as it is solved
    where: tuple[str, ...]  # definitions of the symbols that occur
    feedback: Rows = ()  # the optimal control of the plant


def equation(scene: Scene) -> Equation:
    """The equation of a scene with exactly its terms."""
    effects = scene.effects
    free = scene.motion.drive == "force"
    damped, heavy, two_way = effects.damping is not None, effects.gravity is not None, effects.reaction
    dragged = effects.damping is not None and effects.damping.drag == "space" and effects.damping.alpha > 0
    weight = ("M_hand g",) if effects.gravity is not None and effects.gravity.hand_weight else ()

    tissue = ["M_es q_s''", "M_ee q_e''"] + (["D_es q_s'", "D_ee q_e'"] if damped else [])
    tissue += ["K_es q_s", "K_ee q_e"]
    hand, load = ["M_ss q_s''"], ["u"]
    if two_way:
        hand += ["M_se q_e''"] + (["D_ss q_s'", "D_se q_e'"] if damped else []) + ["K_ss q_s", "K_se q_e"]
    if (two_way and heavy) or weight:
        load.append("f_s")
    blocks = (("hand", tuple(hand), tuple(load)), ("tissue", tuple(tissue), ("f_e",) if heavy else ("0",)))

    fall = "(q_s'' - g)" if heavy else "q_s''"
    drag = ("- alpha G q_s'",) if dragged else ()
    left = ("M_ee z''", *(("D_ee z'",) if damped else ()), "f(z)" if effects.finite_strain else "K_ee z")
    rows = [("tissue", left, (f"-G {fall}", *drag))]
    forces = ["M_hand q_s''"]
    if two_way:
        forces += [f"M_r {fall}", "G' z''"] + (["alpha M_r q_s'", "alpha G' z'"] if dragged else [])
    if free:
        rows.append(("hand", tuple(forces), ("u(t)", *weight)))
    else:
        rows.append(("hand", ("q_s",), (_motion(scene),)))
        if two_way:
            rows.append(("force it takes", ("u",), (*forces, *(f"- {w}" for w in weight))))
    return Equation(blocks, tuple(rows), _definitions(scene, dragged, free))


def _motion(scene: Scene) -> str:
    motion = scene.motion
    if motion.profile == "quintic":
        return "target s(t), s = 10 x^3 - 15 x^4 + 6 x^5, x = min(t / duration, 1)"
    return "cubic spline through the csv table, at rest at both ends" if motion.profile == "csv" else "0"


def _definitions(scene: Scene, dragged: bool, free: bool) -> tuple[str, ...]:
    effects, layers = scene.effects, "sum over layers of " if scene.tissue.layers else ""
    finite = effects.finite_strain
    strain = [] if finite is None else [f"f(z) = dW/dz, W(F) {finite.law}, F = I + grad z"]
    result = [
        *strain,
        "q_s: translations" + (" and small angles" if effects.rotation else "") + " of the hand",
        "z = q_e - T q_s: displacement of the tissue against the rigid motion T q_s",
        "G = M_es + M_ee T; K_es = -K_ee T",
        f"K_ee = {layers}mu K_mu + lambda K_lambda, M_ee = {layers}rho M_1",
    ]
    if effects.reaction:
        result.append("two-way: M_se = M_es', K_se = K_es', M_ss = M_hand + R' M R, M_r: rigid tissue inertia")
    else:
        result.append("one-way: the hand does not feel the tissue, M_ss = M_hand, M_se = 0, K_ss = K_se = 0")
    if effects.damping is not None:
        beta = "beta K_ee" if not layered(scene) else "sum over layers of beta K"
        damping = f"alpha M_ee + {beta}" if effects.damping.alpha else beta
        result.append(
            f"D_ee = {damping}, D_es = -D_ee T"
            + (" + alpha G: dragged in space" if dragged else ": a rigid move is free")
        )
        if effects.reaction:
            result.append("D_se = D_es', D_ss = T' D_ee T" + (" + alpha (R' M R - T' M_ee T)" if dragged else ""))
    if effects.gravity is not None:
        result.append("f_e = G g" + ("; f_s = (R' M R + M_se T) g" if effects.reaction else ""))
        if effects.gravity.hand_weight:
            result.append("f_s " + ("also has" if effects.reaction else "=") + " M_hand g")
    if free:
        drive = {
            "csv": "csv table, straight lines between its rows",
            "hold": "0",
            "quintic": "M_hand q'' of the quintic move to the target",
        }
        result.append(f"u(t): {drive[scene.motion.profile]}")
    else:
        kept = ", which simulate writes to trajectory.csv" if effects.reaction else ""
        result.append(f"the motion is prescribed: the hand's row only tells the force u{kept}")
    return tuple(result)
