"""Hard cases of the static full-order model: nearly incompressible, layered, slender and badly meshed tissue."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.fem.scene import materials
from softgrasp.fem.solve.solvers import choose_solver
from softgrasp.fem.solve.statics import equilibrium
from tests.hardcases.cases import EPS, Family, HardCase, Outcome, here, make, scaled_condition, textbook, thin
from tests.hardcases.textbook import linear_triangles, solve_twice

CELLS = 4  # over the height 1 of the beam
REFUSED = 1e-6  # estimated error at which a static solve is refused
HOLD = ("motion={profile='hold'}", "time={steps=1, end=1.0}", "hand={mass=1.0}")
BEAM = ("tissue.size=[4.0, 1.0]", "contact={sides=['left']}", "effects={gravity={g=[0.0, -1.0]}}", *HOLD)
COLUMN = ("tissue.size=[1.0, 2.0]", "contact={sides=['top']}", "effects={gravity={g=[0.0, -1.0]}}", *HOLD)


def static(model: Model, checked: bool = True) -> Array:
    """Displacement under gravity with the residual checked, or by SuperLU, believed as it is; dofs of one rank."""
    if checked:
        return equilibrium(model.system, choose_solver(model.system.layout)[0], model.scene.time)
    load = model.system.G @ np.array([0.0, -1.0])
    return np.asarray(scipy.sparse.linalg.spsolve(to_scipy(model.system.K_ee).tocsc(), load))


def tip(model: Model, checked: bool) -> float:
    """Last component of the scene's only output."""
    output = make_outputs(model.scene, model.system)[0]
    return float(static(model, checked)[output.dofs[0, -1]])


# --- nearly incompressible


def _sag(nu: float, order: int, cells: str, check: bool = True) -> float:
    overrides = (f"tissue.material={{young=1000.0, poisson={nu!r}, rho=1.0}}", f"tissue.order={order}")
    node = "control.outputs=[{kind='node', point=[4.0, 0.5]}]"
    return tip(make("paper_forward", *BEAM, *overrides, f"tissue.cells={cells}", node), check)


def _sag_error(nu: float, order: int, reference: float, check: bool) -> float:
    return abs(_sag(nu, order, f"[{4 * CELLS}, {CELLS}]", check) / reference - 1)


def locking_rows(quick: bool) -> Iterator[HardCase]:
    """Tip of a heavy beam against P2 on a finer mesh by SuperLU, for nu up to 0.49999."""
    for nu in thin([0.3, 0.45, 0.49, 0.499, 0.4999, 0.49999], quick):
        reference = _sag(nu, 2, "[32, 8]" if quick else "[64, 16]", check=False)
        p2, locked = here(_sag_error, nu, 2, reference, True), textbook(_sag_error, nu, 1, reference, False)
        reason = "P2 keeps one order of h in the energy for every nu [BS92], so its square at the tip: h = 1/4"
        yield HardCase(f"nu = {nu:g}", 1 - 2 * nu, p2, locked, CELLS**-2.0, reason)
    for value in (0.5, 0.6):
        goes_on = textbook(lambda: Outcome(None, f"goes on with lambda = {materials.lame(1000.0, value)[0]:g}"))  # noqa: B023
        refusal = here(_sag, value, 2, "[4, 1]")
        yield HardCase(f"nu = {value!r}", 0.0, refusal, goes_on, None, "lambda is infinite or negative")


# --- layers


def stretch_error(y: Array, z: Array, height: float, contrast: float = 1.0) -> float:
    """Worst relative error of the mean stretch of a hanging column below and above a height, exact by one integral.

    With lambda = 0 the column of height 2 is in uniaxial stress rho g y, so that u(y) = -int_y^2 rho g s / (2 mu) ds;
    below ``height`` mu is ``contrast`` times larger. The mean over x leaves out that the lower part may turn as a
    whole, which is no stretch.
    """
    u, mu = z[1::2], 50.0
    bottom, edge = (float(u[np.abs(y - level) < 1e-9].mean()) for level in (0.0, height))
    upper, lower = -(4 - height**2) / (4 * mu), -(height**2) / (4 * mu * contrast)
    return max(abs(edge / upper - 1), abs((bottom - edge) / lower - 1))


def _stretch_here(model: Model, height: float, contrast: float) -> float:
    return stretch_error(model.system.layout.nodes[:, 1], static(model), height, contrast)


def _stretch_scipy(model: Model, height: float, contrast: float) -> Outcome:
    load, y = model.system.G @ np.array([0.0, -1.0]), model.system.layout.nodes[:, 1]
    return solve_twice(to_scipy(model.system.K_ee), load, lambda z: stretch_error(y, z, height, contrast))


def contrast_rows(quick: bool) -> Iterator[HardCase]:
    """A stiff and a soft layer hanging from each other; both stretches are known exactly."""
    for power in thin([-6, -4, -2, 0, 2, 4, 6], quick):
        c = 10.0**power
        low = f"tissue.layers.low={{box=[[0.0, 0.0], [1.0, 1.0]], material={{lambda=0.0, mu={50 * c!r}, rho=1.0}}}}"
        column = ("tissue.material={lambda=0.0, mu=50.0, rho=1.0}", "tissue.cells=[4, 8]", "tissue.order=2", low)
        model = make("paper_forward", *COLUMN, *column)
        bound = EPS * scaled_condition(model.system.K_ee)
        reason = "eps times the condition of K scaled to a unit diagonal [VDS69]: what a direct factor may lose"
        answers = here(_stretch_here, model, 1.0, c), textbook(_stretch_scipy, model, 1.0, c)
        yield HardCase(f"lower layer {c:g} times as stiff", c, *answers, bound, reason)


# --- shape


def _beam_error(slender: float, order: int, check: bool) -> float:
    """Relative error of the tip of a heavy cantilever of height 1 against Timoshenko: E = 1, G = 1/2, I = 1/12."""
    shape = (f"tissue.size=[{slender!r}, 1.0]", "tissue.cells=[32, 2]", f"tissue.order={order}")
    beam = (
        "tissue.material={lambda=0.0, mu=0.5, rho=1.0}",
        f"control.outputs=[{{kind='node', point=[{slender!r}, 0.5]}}]",
    )
    model = make("paper_forward", *shape, *beam, *BEAM[1:])
    exact = slender**4 / (8 / 12) + slender**2 / (2 * 0.5 * 5 / 6)  # shear factor 5/6
    return abs(-tip(model, check) / exact - 1)


def slender_rows(quick: bool) -> Iterator[HardCase]:
    """Tip of a slender cantilever under its weight against Timoshenko's beam, 32 cells along it."""
    for slender in thin([5.0, 20.0, 100.0, 300.0, 1e3, 1e4, 1e5], quick):
        p2, locked = here(_beam_error, slender, 2, True), textbook(_beam_error, slender, 1, False)
        bound = 32**-2 + slender**-2
        reason = (
            "32 cells along the beam follow its curvature to 1/32^2 and beam theory leaves out (height / length)^2; "
            "the condition grows with the fourth power of the slenderness, past 100 rounding may leave too few digits"
        )
        may = slender > 100
        yield HardCase(f"length / height = {slender:g}", slender, p2, locked, bound, reason, may_refuse=may)


def sliver_mesh(gap: float) -> tuple[Array, NDArray[np.int64]]:
    """Nodes and cells of a column of 1 x 2 with two rows of nodes ``gap`` apart at mid height."""
    columns = 4
    heights = [0.0, 0.5, 1.0 - gap / 2, 1.0 + gap / 2, 1.5, 2.0]
    nodes = [(i / columns, y) for y in heights for i in range(columns + 1)]
    cells = []
    for row, i in itertools.product(range(len(heights) - 1), range(columns)):
        a, b = row * (columns + 1) + i, (row + 1) * (columns + 1) + i
        cells += [(a, a + 1, b + 1), (a, b + 1, b)]
    return np.array(nodes), np.array(cells)


def by_hand(nodes: Array, cells: NDArray[np.int64]) -> Outcome:
    """P1 assembled by hand from the same cells, solved by SciPy, for meshes that the reader refuses."""
    K, f = linear_triangles(nodes, cells, 50.0)
    free = np.repeat(nodes[:, 1] < 2.0, 2)

    def error(part: Array) -> float:
        z = np.zeros(2 * len(nodes))
        z[free] = part
        return stretch_error(nodes[:, 1], z, 0.5)

    outcome = solve_twice(K[free][:, free], -f[free], error)
    return replace(outcome, text=f"P1 by hand; {outcome.text}")


def sliver_rows(quick: bool) -> Iterator[HardCase]:
    """A row of ever flatter cells through a hanging column whose displacement is known exactly."""
    with tempfile.TemporaryDirectory() as folder:
        for power in thin([-1, -3, -5, -7, -9, -11, -13, -15], quick):
            gap, path = 10.0**power, Path(folder) / f"sliver{-power:g}.mesh"
            nodes, cells = sliver_mesh(gap)
            lines = ["MeshVersionFormatted 2", "Dimension 2", f"Vertices\n{len(nodes)}"]
            lines += [f"{x!r} {y!r} 0" for x, y in nodes.tolist()] + [f"Triangles\n{len(cells)}"]
            lines += [f"{a} {b} {c} 0" for a, b, c in (cells + 1).tolist()] + ["End", ""]
            path.write_text("\n".join(lines))
            mesh = f"tissue={{mesh='{path}', order=2, material={{lambda=0.0, mu=50.0, rho=1.0}}}}"
            scene = (mesh, *COLUMN[1:], "control=false")
            answer = here(lambda s: _stretch_here(make("paper_forward", *s), 0.5, 1.0), scene)
            read = power > -12  # flatter than 1e-12 must be refused
            model = make("paper_forward", *scene) if read else None
            assembled = None if model is None else textbook(_stretch_scipy, model, 0.5, 1.0)
            condition = 0.0 if model is None else scaled_condition(model.system.K_ee)
            bound = min(EPS * condition, 10 * REFUSED) if read else None
            reason = (
                "eps times the condition of K scaled to a unit diagonal [VDS69], which grows as 1 / height, but at "
                "most ten times the estimate at which a solve is refused; below 1e-12 the cells have no area in doubles"
            )
            answers = answer, assembled or textbook(by_hand, nodes, cells)
            yield HardCase(f"cells of height {gap:.0e}", gap, *answers, bound, reason, may_refuse=power < -6)


FAMILIES = (
    Family("locking", "Nearly incompressible tissue", "$1 - 2\\nu$", "relative error of the sag", "P1 on the same mesh",
           "P1 displacements lock as nu goes to 1/2 and report a body that hardly moves; P2 keeps its error.",
           locking_rows),
    Family("contrast", "Stiffness contrast between layers", "stiffness of the lower layer over the upper",
           "relative error of the layers' stretch", "SciPy's direct solve",
           "Digits are lost in the stiff layer only, which hardly stretches, and by every solver alike: this one, "
           "SciPy's direct one and CG with the diagonal as preconditioner.",
           contrast_rows),
    Family("slender", "Slender body", "length / height", "relative error of the tip", "P1 on the same mesh",
           "P1 cells lock in bending; P2 follows beam theory until rounding ends it, and then the run is refused.",
           slender_rows),
    Family("sliver", "Sliver cells", "height of the flattest cells [m]", "relative error of the displacement",
           "SciPy's direct solve",
           "Flat cells spoil the condition number for every solver. Here a sentence says when too few digits are left, "
           "and cells that have no area in doubles are refused.",
           sliver_rows),
)  # fmt: skip
