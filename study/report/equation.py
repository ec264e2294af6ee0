"""The equation of a scene with exactly its terms, in LaTeX.

Two forms of one equation: the paper's blocks in q = [q_s; q_e], and the one that is stepped, in the displacement
z = q_e - T q_s against the rigid motion of the hand.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from softgrasp.fem import Scene, layered

PLAIN = (  # pattern of LaTeX, what a terminal shows
    (r"\\dot \\Omega", "Omega'"), (r"\\times", "x"),
    (r"\\ddot (\w(_\w)?)", r"\1''"), (r"\\dot (\w(_\w)?)", r"\1'"), (r"\^\\top", "'"), (r"\\text|[\\${}]", ""),
)  # fmt: skip
FEEDBACK = (
    ("state", (r"$E \dot x$",), ("$A x$", r"$B u$, $x = [q_s, \dot q_s, z, \dot z]$")),
    ("output", ("$y$",), ("$C x$",)),
    (
        "cost",
        ("$J$",),
        (
            r"$\int \langle y - y_\text{target}, Q (y - y_\text{target}) \rangle$",
            r"$\langle u, R u \rangle \, dt$",
        ),
    ),
    ("Riccati", (r"$A^\top P E$", r"$E^\top P A$", r"$- E^\top P B R^{-1} B^\top P E$", r"$C^\top Q C$"), ("$0$",)),
    ("gain", ("$u$",), (r"$u_\text{target}$", r"$K (x - x_\text{target})$, $K = {-R^{-1}} B^\top P E$")),
)
Rows = tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...]


@dataclass(frozen=True)
class Equation:
    """The equation of one scene: prose with formulas in LaTeX, each row the terms of a left and a right side."""

    blocks: Rows  # rows of the paper's block system in q_s, q_e, as (name, left terms, right terms)
    stepped: Rows  # rows of the block system in z, as it is solved
    where: tuple[str, ...]  # definitions of the symbols that occur
    feedback: Rows = ()  # the optimal control of the plant

    def plain(self) -> Equation:
        """The same for a terminal: derivatives and transposes by primes, Greek letters by their names."""
        blocks, stepped = (
            tuple((name, tuple(map(_plain, left)), tuple(map(_plain, right))) for name, left, right in rows)
            for rows in (self.blocks, self.stepped)
        )
        return Equation(blocks, stepped, tuple(map(_plain, self.where)))

    def lines(self) -> list[str]:
        """A plain equation in blocks, as it is stepped, and what the symbols are."""
        lines = []
        for title, rows in (("in blocks:", self.blocks), ("stepped as:", self.stepped)):
            if not rows:
                continue
            wide = 1 + max(len(name) for name, _, _ in rows)
            lines.append(title)
            for name, *sides in rows:
                left, right = (" + ".join(terms).replace("+ -", "-") for terms in sides)
                lines.append(f"  {name + ':':<{wide}} {left} = {right}")
            lines.append("")
        return [*lines, "with:", *(f"  {text}" for text in self.where)]

    def html(self) -> Markup:
        """For a page: formulas in MathML, lines that break between terms only."""
        parts = []
        for head, part in (("in blocks", self.blocks), ("stepped as", self.stepped), ("controlled by", self.feedback)):
            parts += [Markup('<p class="head">{}</p>').format(head)] if part else []
            for name, left, right in part:
                sides = Markup(" ").join([*terms(left), *terms(right, "=")])
                parts.append(Markup('<p class="row"><span class="name">{}</span> {}</p>').format(name, sides))
        parts.append(Markup('<p class="head">with</p>'))
        parts += [Markup('<p class="where">{}</p>').format(prose(text)) for text in self.where]
        return Markup('<div class="equation">{}</div>').format(Markup("\n").join(parts))


def _plain(text: str) -> str:
    for pattern, shown in PLAIN:
        text = re.sub(pattern, shown, text)
    return text


def prose(text: str) -> Markup:
    """Text with formulas between dollars, as HTML."""
    from latex2mathml.converter import convert  # brings an HTTP client

    parts = re.split(r"\$(.*?)\$", text)
    return Markup("").join(Markup(convert(part)) if i % 2 else escape(part) for i, part in enumerate(parts))


def terms(side: Sequence[str], first: str = "") -> list[Markup]:
    """The terms of a side, each behind its sign; a line may break between them."""
    signs = [first, *("−" if term.startswith("$-") else "+" for term in side[1:])]
    shown = [side[0], *(f"${term[2:]}" if term.startswith("$-") else term for term in side[1:])]
    return [
        Markup('<span class="term">{}</span>').format(prose(f"{sign} {term}".strip()))
        for sign, term in zip(signs, shown, strict=True)
    ]


def equation(scene: Scene) -> Equation:
    """The equation of a scene with exactly its terms."""
    effects = scene.effects
    free = scene.motion.drive == "force"
    damped, heavy, two_way = effects.damping is not None, effects.gravity is not None, effects.reaction
    dragged = effects.damping is not None and effects.damping.drag == "space" and effects.damping.alpha > 0
    weight = (r"$M_\text{hand} g$",) if effects.gravity is not None and effects.gravity.hand_weight else ()

    tissue = [r"$M_{es} \ddot q_s$", r"$M_{ee} \ddot q_e$"]
    tissue += [r"$D_{es} \dot q_s$", r"$D_{ee} \dot q_e$"] if damped else []
    tissue += ["$K_{es} q_s$", "$K_{ee} q_e$"]
    hand, load = [r"$M_{ss} \ddot q_s$"], ["$u$"]
    if two_way:
        hand += [r"$M_{se} \ddot q_e$", *((r"$D_{ss} \dot q_s$", r"$D_{se} \dot q_e$") if damped else ())]
        hand += ["$K_{ss} q_s$", "$K_{se} q_e$"]
    if (two_way and heavy) or weight:
        load.append("$f_s$")
    blocks = (("hand", tuple(hand), tuple(load)), ("tissue", tuple(tissue), ("$f_e$",) if heavy else ("$0$",)))

    fall = r"(\ddot q_s - g)" if heavy else r"\ddot q_s"
    drag = (r"$- \alpha G \dot q_s$",) if dragged else ()
    if effects.frame is not None:
        return _turning_equation(scene, free, damped, heavy)
    inner = "$f(z)$" if effects.finite_strain else "$K_{ee} z$"
    left = (r"$M_{ee} \ddot z$", *((r"$D_{ee} \dot z$",) if damped else ()), inner)
    rows = [("tissue", left, (f"$-G {fall}$", *drag))]
    forces = [r"$M_\text{hand} \ddot q_s$"]
    if two_way:
        forces += [f"$M_r {fall}$", r"$G^\top \ddot z$"]
        forces += [r"$\alpha M_r \dot q_s$", r"$\alpha G^\top \dot z$"] if dragged else []
    if free:
        rows.append(("hand", tuple(forces), ("$u(t)$", *weight)))
    else:
        rows.append(("hand", ("$q_s$",), (_motion(scene),)))
        if two_way:
            rows.append(("required force", ("$u$",), (*forces, *(f"$- {w[1:]}" for w in weight))))
    return Equation(blocks, tuple(rows), _definitions(scene, dragged, free))


def _turning_equation(scene: Scene, free: bool, damped: bool, heavy: bool) -> Equation:
    """The equation in the frame of a hand that turns by any angle."""
    effects = scene.effects
    inner = "$f(z)$" if effects.finite_strain else "$K_{ee} z$"
    fall = r"(a - Q^\top g)" if heavy else "a"
    left = (
        r"$M_{ee} \ddot z$", r"$2 \Omega \times M_{ee} \dot z$",
        r"$(\dot \Omega \times + \Omega \times \Omega \times) M_{ee} z$",
        *((r"$D_{ee} \dot z$",) if damped else ()), inner,
    )  # fmt: skip
    load = (f"$-G_t {fall}$", r"$- G_r \dot \Omega$", r"$- S : (\Omega \times)^2$")
    rows: list[tuple[str, tuple[str, ...], tuple[str, ...]]] = [("tissue", left, load)]
    momenta = (r"$\dot P$", r"$\dot L + \dot p \times P$")
    weigh = [
        name
        for name, on in (("hand", effects.gravity and effects.gravity.hand_weight), ("tissue", effects.reaction))
        if on
    ]
    weight = ("$F_g$",) if heavy and weigh else ()
    if free:
        rows.append(("hand", momenta, ("$u(t)$", *weight)))
    else:
        rows.append(("hand", ("$[p, Q]$",), (_motion(scene),)))
        if effects.reaction:
            rows.append(("required force", ("$u$",), (*momenta, *(f"$- {w[1:]}" for w in weight))))
    finite = effects.finite_strain
    where = [
        *([] if finite is None else [rf"$f(z) = dW/dz$, $W(F)$ {finite.law}, $F = I + \text{{grad }}z$"]),
        "$q_s = [p, \\theta]$: displacement of the reference point and rotation vector of $Q$, any angle",
        "$z$: displacement of the tissue against the hand, in its axes; a point at $r$ goes to $p + Q (r + z)$",
        r"$a = Q^\top \ddot p$, $\Omega$: acceleration and angular velocity of the hand in its axes",
        r"$G = [G_t, G_r] = M_{es} + M_{ee} T$, $S_{kl} = \int \rho \phi_k r_l$: inertia loads of a rigid turn",
        r"$P$, $L$: momenta of the hand"
        + (
            " and the tissue, $L$ about the reference point" if effects.reaction else ", which does not feel the tissue"
        ),
    ]
    if weight:
        where.append(f"$F_g$: weight of the {' and the '.join(weigh)}, and its torque")
    damping = [text for text in _definitions(scene, False, free) if text.startswith(("$D_{ee}", "$u(t)$", "$K_{ee}"))]
    return Equation((), tuple(rows), (*where, *(text.split(", $D_{es}")[0] for text in damping)))


def _motion(scene: Scene) -> str:
    motion = scene.motion
    if motion.profile == "quintic":
        return r"target $s(t)$, $s = 10 x^3 - 15 x^4 + 6 x^5$, $x = \text{min}(t / \text{duration}, 1)$"
    return "cubic spline through the csv table, at rest at both ends" if motion.profile == "csv" else "$0$"


def _own_parts(scene: Scene) -> str:
    """What an own energy adds to the stiffness, in words."""
    if scene.tissue.energy is None:
        return ""
    return f" and the parts of the other parameters of {scene.tissue.energy}, all of its tangent at rest"


def _definitions(scene: Scene, dragged: bool, free: bool) -> tuple[str, ...]:
    effects, layers = scene.effects, "sum over layers of " if scene.tissue.layers else ""
    finite = effects.finite_strain
    law = "" if finite is None else scene.tissue.energy or finite.law
    strain = [] if finite is None else [rf"$f(z) = dW/dz$, $W(F)$ {law}, $F = I + \text{{grad }}z$"]
    result = [
        *strain,
        "$q_s$: translations" + (" and small angles" if effects.rotation else "") + " of the hand",
        "$z = q_e - T q_s$: displacement of the tissue against the rigid motion $T q_s$",
        "$G = M_{es} + M_{ee} T$; $K_{es} = {-K_{ee}} T$",
        rf"$K_{{ee}} =$ {layers}$\mu K_\mu + \lambda K_\lambda${_own_parts(scene)}, $M_{{ee}} =$ {layers}$\rho M_1$",
    ]
    if effects.reaction:
        result.append(
            r"two-way: $M_{se} = M_{es}^\top$, $K_{se} = K_{es}^\top$, $M_{ss} = M_\text{hand} + R^\top M R$, "
            "$M_r$: rigid tissue inertia"
        )
    else:
        result.append(
            r"one-way: the hand does not feel the tissue, $M_{ss} = M_\text{hand}$, $M_{se} = 0$, $K_{ss} = K_{se} = 0$"
        )
    if effects.damping is not None:
        beta = "sum over layers of $\\beta K$" if layered(scene) else r"$\beta K_{ee}$"
        result.append(
            "$D_{ee} =$ " + (r"$\alpha M_{ee} +$ " if effects.damping.alpha else "") + beta + ", $D_{es} = {-D_{ee}} T$"
            + (r" $+ \alpha G$: dragged in space" if dragged else ": a rigid move is free")
        )  # fmt: skip
        if effects.reaction:
            more = r" $+ \alpha (R^\top M R - T^\top M_{ee} T)$" if dragged else ""
            result.append(r"$D_{se} = D_{es}^\top$, $D_{ss} = T^\top D_{ee} T$" + more)
    if effects.gravity is not None:
        result.append("$f_e = G g$" + (r"; $f_s = (R^\top M R + M_{se} T) g$" if effects.reaction else ""))
        if effects.gravity.hand_weight:
            result.append("$f_s$ " + ("also has" if effects.reaction else "$=$") + r" $M_\text{hand} g$")
    if free:
        drive = {
            "csv": "csv table, straight lines between its rows",
            "hold": "$0$",
            "quintic": r"$M_\text{hand} \ddot q$ of the quintic move to the target",
        }
        result.append(f"$u(t)$: {drive[scene.motion.profile]}")
    else:
        kept = ", which simulate writes to trajectory.csv" if effects.reaction else ""
        result.append(f"the motion is prescribed: the hand's row gives the force $u$ that the motion requires{kept}")
    return tuple(result)


def control_equation(scene: Scene) -> Equation:
    """The scene's equation with a force on the hand, then cost, Riccati equation and gain.

    u_target holds the body at rest at the target: the hand's weight, else nothing.
    """
    free = scene.model_copy(update={"motion": scene.motion.model_copy(update={"drive": "force", "profile": "hold"})})
    plant = equation(free)
    stepped = tuple(
        (name, left, tuple(term.replace("u(t)", "u") for term in right)) for name, left, right in plant.stepped
    )
    where = tuple(text for text in plant.where if not text.startswith("$u(t)$:"))
    return Equation(plant.blocks, stepped, where, FEEDBACK)
