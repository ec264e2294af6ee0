"""A disc pressed into a block, beside Hertz: a^2 = 4 P R / (pi E*), p = p_0 sqrt(1 - (x / a)^2) in plane strain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np

from softgrasp.fem.model.build import build
from softgrasp.fem.model.surface import make_surface
from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.fem.run.simulate import simulate

R, SIDE, YOUNG, NU = 200.0, 10.0, 1000.0, 0.3  # radius of the disc, half the width and the height of the block
HALF_WIDTH = 0.2  # about, of the contact [m]
DEPTH = 0.00045  # by which the disc is in the way of the block [m]
SCENE = """name = "hertz"
[tissue]
mesh = "hertz.msh"
order = {order}
material = {{ young = {young}, poisson = {nu}, rho = 1.0 }}
[contact]
box = [[-11.0, 9.999999], [11.0, 11.0]]
[motion]
profile = "hold"
[effects]
obstacles = true
[[obstacle]]
kind = "disc"
center = [0.0, {center!r}]
radius = {radius}
[time]
steps = 1
end = 1e-6
start = "equilibrium"
"""


def lines(h: float, inner: float, end: float) -> Array:
    """Places from 0 to an end, with distance h up to ``inner`` and growing ones after it."""
    x, step = list(np.arange(0, inner + h / 2, h)), h
    while x[-1] < end:
        step *= 1.25
        x.append(min(end, x[-1] + step))
    if x[-1] - x[-2] < 0.4 * (x[-2] - x[-3]):
        del x[-2]
    return np.array(x)


def write_mesh(h: float, path: Path) -> None:
    """Write triangles of a block whose lines crowd at the middle of its lower side."""
    right, up = lines(h, 1.6 * HALF_WIDTH, SIDE), lines(h, 2 * h, SIDE)
    x, cells = np.concatenate([-right[:0:-1], right]), []
    n = len(x)
    for j in range(len(up) - 1):
        for i in range(n - 1):
            a, b, c, d = (j * n + i + k for k in (0, 1, n, n + 1))
            cells += [[a, b, d], [a, d, c]] if x[i] + x[i + 1] < 0 else [[a, b, c], [b, d, c]]
    points = np.array([[a, b, 0.0] for b in up for a in x])
    meshio.write(path, meshio.Mesh(points, [("triangle", np.array(cells))]), file_format="gmsh")


@dataclass(frozen=True)
class Pressed:
    """What the boundary nodes of a block carry, beside Hertz at the same force."""

    x: Array
    """Places of the nodes that carry, ascending, (nodes,) [m]."""
    pressure: Array
    """Force over the integral of the node's shape function, (nodes,) [Pa]."""
    a: float
    """Half-width of Hertz at this force [m]."""
    peak: float
    """Pressure of Hertz in the middle at this force [Pa]."""
    width: float
    """Half-width from the second moment of the forces, P a^2 / 4 [m]."""

    @property
    def errors(self) -> tuple[float, float]:
        """Relative errors of the half-width and of the pressure in the middle."""
        return self.width / self.a - 1, float(self.pressure[np.abs(self.x).argmin()]) / self.peak - 1


def press(order: int, h: float, folder: Path) -> Pressed:
    """Press the disc into a block whose elements have edges h in the contact."""
    write_mesh(h, folder / "hertz.msh")
    text = SCENE.format(order=order, young=YOUNG, nu=NU, center=DEPTH - R, radius=R)
    (folder / "hertz.toml").write_text(text)
    model = build(str(folder / "hertz.toml"))
    result, system, surface = simulate(model), model.system, make_surface(model.space, model.system)
    z = result.snapshots.Z[: system.layout.n_e, 0]
    f = (to_scipy(system.K_ee) @ z)[surface.rows[1::2]]  # what the obstacle must press with, upwards
    x, on = surface.X[:, 0], np.abs(f) > 1e-9 * np.abs(f).max()
    assert f[on].min() > 0, (x[on], f[on])
    assert np.abs(x[on]).max() < 1.6 * HALF_WIDTH - h / 2  # where the edges are even
    P, stiffness = f.sum(), YOUNG / (1 - NU**2)
    places = np.round(x[on] / h * 2).astype(int)  # in half edges from the middle
    share = np.where(places % 2 == 0, 1 / 3, 2 / 3) if order == 2 else np.ones(len(places))
    order_of = np.argsort(x[on])
    return Pressed(
        x[on][order_of],
        (f[on] / (share * h))[order_of],
        float(np.sqrt(4 * P * R / (np.pi * stiffness))),
        float(np.sqrt(P * stiffness / (np.pi * R))),
        float(2 * np.sqrt(f @ x**2 / P)),
    )
