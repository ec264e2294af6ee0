"""The effects a scene can switch on: what each adds to the equation, allocates and costs, and when it matters."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.gate import Effect, Gate, Problem, force_drives
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.materials import young_poisson
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.system import Damping, LayerBlocks, LayerMaterial, layered_viscosity

EARTH = 9.81  # [m/s2], assumed when the scene leaves gravity off
# Error of linear elasticity over rms|grad z|, measured: on the paper's scene 0.29 to 0.37 over seven materials and six
# amplitudes; on blocks, plates and strips of tetrahedra 0.46 to 1.7 for moves in all directions, 0.28 to 0.31 across. A
# block in plane strain has 2/3 of what it has in 3D under the same move, so the dimension counts; the direction counts
# as well, and the factor is the geometric mean of what was seen.
SLOPE = {2: 0.35, 3: 0.7}


def acceleration(scene: Scene, n_s: int) -> Array | None:
    """Free fall in the hand's degrees of freedom, g = [g_1 .. g_d, 0 ..] (n_s,) [m/s2]; None when off."""
    gravity = scene.effects.gravity
    if gravity is None:
        return None
    return np.pad(np.asarray(gravity.g, dtype=float), (0, n_s - len(gravity.g)))


def operator(scene: Scene, layers: tuple[LayerBlocks, ...], materials: tuple[LayerMaterial, ...]) -> Damping:
    """D = alpha M + beta K, or with a matrix when the layers differ in beta. Collective."""
    law = scene.effects.damping
    if law is None:
        return Damping()
    matrix = layered_viscosity(layers, materials)
    return Damping(law.alpha, 0.0 if matrix is not None else materials[0].beta, law.drag == "space", matrix)


def ratios(alpha: float, beta: float, omega: Array) -> Array:
    """Damping ratios zeta_k = (alpha / omega_k + beta omega_k) / 2 of uniform damping."""
    return (alpha / omega + beta * omega) / 2


def layered(scene: Scene) -> bool:
    """Whether a layer has a Kelvin-Voigt time of its own."""
    damping = scene.effects.damping
    return damping is not None and any(
        layer.beta is not None and layer.beta != damping.beta for layer in scene.tissue.layers.values()
    )


def hand_inertia(scene: Scene, d: int) -> Array | None:
    """Moments of inertia of the hand, one per rotation, (d (d - 1) / 2,) [kg m2]; None if not given."""
    if scene.hand.inertia is None:
        return None
    given = np.atleast_1d(np.asarray(scene.hand.inertia, dtype=float))
    return np.broadcast_to(given, (d * (d - 1) // 2,)).copy()


def hand_mass(scene: Scene, d: int) -> Array:
    """M_hand = blkdiag(m I, inertia), (n_s, n_s) [kg, kg m2]."""
    diagonal = np.full(d, scene.hand.mass)
    inertia = hand_inertia(scene, d)
    if scene.effects.rotation and inertia is not None:
        diagonal = np.append(diagonal, inertia)
    return np.diag(diagonal)


def linear_error(rms: float, dimension: int) -> float:
    """Estimated error that linear elasticity makes in the deformation [1], from rms|grad z| of its answer."""
    return SLOPE[dimension] * rms


class GravityEffect(Effect):
    """Body force rho g: f_e = G g, for K_ee T + K_es = 0 makes falling the same as accelerating the hand."""

    name = "gravity"
    term = "f_e = G g, as the load -G (q_s'' - g)"
    cost = "Gravity takes no operator and no work in a step: G multiplies q_s'' - g instead of q_s''."
    threshold = 0.01

    def gate(self, problem: Problem) -> Gate:
        """Gradient of the static displacement under the weight, bending included; `fem.fields.sag` solves for it."""
        off, sag, length = problem.scene.effects.gravity is None, problem.sag, problem.length
        number = sag.gradient.typical
        bends = f"sag by {sag.largest:.2g} m, {sag.largest / length:.2g} of its length {length:.3g} m"
        steep = f"|grad z| is {sag.gradient.largest:.2g} at most"
        begin = (
            f"Off; in SI units and with g = {EARTH} the tissue would" if off else "Under its weight the tissue would"
        )
        holds = "holds" if sag.gradient.linear else f"does not hold, {sag.gradient.share:.0%} of the body is above 0.1"
        sentence = f"{begin} {bends}, by linear elasticity; {steep}: the theory {holds}."
        proviso = "if its numbers are in SI units" if off else ""
        return Gate(number, "|grad z| of its sag", self.threshold, number > self.threshold, sentence, proviso)


class DampingEffect(Effect):
    """D = alpha M + beta K on the motion against the hand, or with drag = "space" against space."""

    name = "damping"
    term = "D_ee z' with D_ee = alpha M_ee + beta K_ee; with drag = 'space' also alpha G q_s'"
    cost = (
        "Equal damping in all layers takes no matrix and a few vector operations a step; layers that differ take D_ee "
        "and two products."
    )

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """D_ee when the layers differ in beta, else none."""
        return ("D_ee",) if layered(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Damping ratio of the first mode against one that takes 5 % of its amplitude in the run.

        A mode decays as exp(-zeta omega t).
        """
        scene, symbol = problem.scene, "zeta_1 = (alpha/omega_1 + beta omega_1)/2"
        if layered(scene):
            symbol = "zeta_1 = phi_1' D phi_1 / (2 omega_1)"
        if not problem.omega:
            sentence = "The first frequencies were not computed, so the damping ratios are unknown."
            unknown = "counts as it is set"
            return Gate(float("nan"), symbol, float("nan"), self.active(scene), sentence, condition=unknown)
        end, omega = scene.time_end, problem.omega[0]
        threshold = 0.05 / (omega * end)
        if scene.effects.damping is None:
            sentence = f"Off: undamped ring-down, nothing decays in the {end * omega / (2 * np.pi):.3g} first periods"
            controlled = scene.control is not None
            sentence += "; feedback alone cannot stabilise the high modes." if controlled else " of the run."
            condition = "counts whatever the number: the control problem needs it" if controlled else ""
            return Gate(0.0, symbol, threshold, controlled, sentence, condition=condition)
        zeta = problem.zeta[0]
        left = float(np.exp(-zeta * omega * end))
        sentence = (
            f"zeta of the first {len(problem.zeta)} modes: {', '.join(f'{z:.2g}' for z in problem.zeta)}; "
            f"{left:.2g} of the first mode's amplitude is left at the end."
        )
        return Gate(zeta, symbol, threshold, zeta > threshold, sentence)


class ReactionEffect(Effect):
    """The inertia of the tissue in the hand's equation; makes M and K symmetric."""

    name = "reaction"
    term = "M_r (q_s'' - g) + G' z'' in the hand's equation"
    cost = (
        "n_s extra solves before the run when a force drives the hand; n_s columns Y and two small reductions a step."
    )
    threshold = 0.05  # the hand's acceleration under a given force changes by about this much

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Y = S^-1 G, n_s columns, and its small product with G, when a force moves the hand."""
        return ("Y", "G'Y") if self.active(scene) and scene.motion.drive == "force" else ()

    def gate(self, problem: Problem) -> Gate:
        """Tissue mass over hand mass; matters only if a force moves the hand."""
        scene = problem.scene
        number = problem.tissue_mass / scene.hand.mass
        change = number / (1 + number)
        on, driven = self.active(scene), force_drives(scene)
        where = "" if scene.motion.drive == "force" else " in the control problem"
        if driven and on:
            sentence = f"The tissue takes about {change:.1%} off the acceleration that a force gives the hand{where}."
        elif driven:
            sentence = f"Off; it would take about {change:.1%} off the acceleration a force gives the hand{where}."
        else:
            sentence = "The motion of the hand is prescribed, so the reaction moves nothing."
        proviso = where.removeprefix(" ") if driven else ""
        large = number > self.threshold
        condition = "counts only where a force drives the hand" if large and not driven else ""
        return Gate(number, "tissue mass / hand mass", self.threshold, driven and large, sentence, proviso, condition)


class RotationEffect(Effect):
    """d (d - 1) / 2 linearised rotations in q_s."""

    name = "rotation"
    term = "d (d-1)/2 small angles in q_s: as many columns more in R, T and G, the hand's inertia in M_ss"
    cost = "R, T and G have 1 column more in 2D and 3 more in 3D; a step multiplies with those columns of G too."
    threshold = 0.05  # the hand's angular acceleration under a given torque changes by about this much

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Columns in operators that are there anyway."""
        return tuple(f"rotation columns of {name}" for name in "RTG") if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Inertia of the rigid tissue about the reference over that of the hand, worst axis.

        A hand of unknown inertia is taken to have the tissue's radius of gyration.
        """
        scene, d = problem.scene, problem.dimension
        hand = hand_inertia(scene, d)
        symbol = "tissue inertia / hand inertia"
        if hand is None:
            number = problem.tissue_mass / scene.hand.mass
            symbol += " (the hand as large as the tissue)"
        else:
            number = float(np.max(np.asarray(problem.tissue_inertia) / hand))
        if not self.active(scene):
            reaction = scene.effects.reaction
            pulled = reaction or problem.tissue_mass / scene.hand.mass > ReactionEffect.threshold
            matters = pulled and force_drives(scene) and number > self.threshold
            sentence = (
                "Off, though the tissue pulls on a hand that a force drives and would turn it."
                if matters and reaction
                else "Off; with the reaction, which this scene calls for too, the tissue would turn the hand."
                if matters
                else "Off; nothing in this scene turns the hand."
                if not reaction
                else "Off; the tissue hardly turns the hand, or the motion is prescribed."
            )
            condition = ""
            if number > self.threshold and not matters:
                condition = "counts only where a force drives the hand and effects.reaction is on"
            proviso = "together with reaction" if matters and not reaction else ""
            return Gate(number, symbol, self.threshold, matters, sentence, proviso, condition)
        angles = (scene.motion.target or [])[d:]
        turned = scene.motion.profile == "csv" or any(angles)
        torque = force_drives(scene)
        if turned:
            sentence = f"The motion turns the hand{f', by up to {max(map(abs, angles)):.3g} rad' if angles else ''}."
        elif torque:
            sentence = f"A torque can turn the hand; tissue inertia is {number:.2g} of the hand's."
        else:
            sentence = "The prescribed motion does not turn the hand."
        condition = "counts only where the motion or a torque turns the hand"
        if turned or torque:
            condition = f"counts whatever the number: {'the motion turns' if turned else 'a torque can turn'} the hand"
        contrary = (number > self.threshold) != (turned or torque)
        return Gate(number, symbol, self.threshold, turned or torque, sentence, condition=condition if contrary else "")


class LayersEffect(Effect):
    """K = sum_k mu_k K_mu,k + lambda_k K_lambda,k and M = sum_k rho_k M_1,k over the layers k."""

    name = "layers"
    term = "sums over the layers in M and K"
    cost = "Each layer takes 3 tissue matrices, which new materials need no assembly for; a step costs nothing more."
    threshold = 1.05  # stiffness within 5 % is one material for any purpose here

    def active(self, scene: Scene) -> bool:
        """Whether the scene has layers."""
        return bool(scene.tissue.layers)

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """The three components of each layer."""
        return tuple(f"{key}[{name}]" for name in scene.tissue.layers for key in ("K_mu", "K_lambda", "M_1"))

    def gate(self, problem: Problem) -> Gate:
        """Contrast max E / min E; layers of one stiffness still matter if another property differs."""
        materials = problem.materials
        young, nu = zip(*(young_poisson(m.lam, m.mu) for m in materials), strict=True)
        rho = [m.rho for m in materials]
        number, symbol = max(young) / min(young), "max E / min E"
        if not self.active(problem.scene):
            return Gate(1.0, symbol, self.threshold, False, "One material.")
        density = max(rho) / min(rho)
        others = [
            word
            for word, differs in (
                ("density", density > self.threshold),
                ("Poisson's ratio", max(nu) - min(nu) > 0.01),
                ("viscosity", len({m.beta for m in materials}) > 1),
            )
            if differs
        ]
        matters = number > self.threshold or bool(others)
        condition = f"counts by its {' and '.join(others)} too" if others and number <= self.threshold else ""
        sentence = f"The stiffest layer is {number:.3g} times as stiff as the softest"
        sentence += f"; they also differ in {' and '.join(others)}." if others else "."
        return Gate(number, symbol, self.threshold, matters, sentence, condition=condition)


class FiniteStrainEffect(Effect):
    """f(z) = dW/dz of a law W(F), F = I + grad z, instead of K_ee z."""

    name = "finite_strain"
    term = "f(z) = dW/dz instead of K_ee z, with W(F) of effects.finite_strain.law and F = I + grad z"
    cost = "The gradient B and the law in every point: two to five iterations a step and now and then a new factor."
    threshold = 0.01  # error of the deformation

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """The gradient in the quadrature points."""
        return ("B",) if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Estimated error of linear elasticity, from its static response to the hand's largest acceleration."""
        scene, number = problem.scene, linear_error(problem.response.rms, problem.dimension)
        symbol = f"{SLOPE[problem.dimension]:g} rms|grad z| of the static response"
        condition = ""
        if scene.effects.rotation and not self.active(scene):
            condition = "cannot be tried beside effects.rotation"
            sentence = f"Off; linear elasticity would be off by about {number:.2g} of the deformation; "
            sentence += "the linearised rotation does not go with finite strain."
            return Gate(number, symbol, self.threshold, False, sentence, condition=condition)
        if self.active(scene):
            sentence = f"Linear elasticity would be off by about {number:.2g} of the deformation."
        else:
            sentence = f"Off; linear elasticity is off by about {number:.2g} of the deformation"
            sentence += ": set effects.finite_strain.law = 'neo-hooke'." if number > self.threshold else "."
        return Gate(number, symbol, self.threshold, number > self.threshold, sentence)


ALL: tuple[Effect, ...] = (
    GravityEffect(), DampingEffect(), ReactionEffect(), RotationEffect(), LayersEffect(), FiniteStrainEffect(),
)  # fmt: skip
"""In the order in which they are reported."""
