"""An energy W(F, parameters) as a law of the points, by the interface of `softgrasp.fem.strain.laws`.

P = dW/dF and A = dP/dF are derivatives of the operations of W; the stress of a step is their discrete derivative, see
`softgrasp.fem.energy.discrete`. W(I + H) - W(I) is the work of that stress on the step from I to I + H, which loses no
digits at small strain. Compiled C computes all of it where there is a compiler, else NumPy.
"""

from __future__ import annotations

import hashlib
import json
from functools import cached_property

import numpy as np

from softgrasp.fem.energy.compiled import EnergyKernel, Library, compiled
from softgrasp.fem.energy.discrete import discrete
from softgrasp.fem.energy.graph import Graph
from softgrasp.fem.energy.program import Operations, Program
from softgrasp.fem.energy.translate import PLACE, entries
from softgrasp.fem.petsc import Array
from softgrasp.fem.strain.laws import Law, Start, volume_change
from softgrasp.fem.strain.points import QuadraturePoints


class EnergyLaw(Law):
    """The law of an energy.

    Args:
        name: what messages call it.
        graph: its operations.
        W: number of the energy among them.
        names: parameters that it depends on.
        d: 2 or 3.

    Attributes:
        inputs: names of the numbers that a point has: the parameters, then the coordinates.
        signature: SHA-256 of the operations, 64 hex digits; the same for the same mathematics in another spelling only
            where UFL makes the same operations of both.
    """

    barrier = True

    def __init__(self, name: str, graph: Graph, W: int, names: list[str], d: int) -> None:
        self.name, self.graph, self.W, self.d = name, graph, W, d
        used = {str(graph.ops[n][1][0]) for n in graph.reached([W]) if graph.ops[n][0] == "input"}
        self.parameters = tuple(names)
        self.inputs = (*names, *(axis for axis in PLACE[:d] if axis in used))
        own = [graph.ops[n] for n in graph.reached([W])]
        numbers = {n: i for i, n in enumerate(graph.reached([W]))}
        listed = [(op, [numbers[a] if op not in ("const", "input") else a for a in args]) for op, args in own]  # type: ignore[index]
        self.signature = hashlib.sha256(json.dumps(listed).encode()).hexdigest()

    # ---- operations

    @cached_property
    def programs(self) -> dict[str, Program]:
        """Energy density, stress (row by row), upper triangle of the tangent, and stress of a step.

        Inputs H.00, H.01, .. at the (first) state and w.00, w.01, .., half the change in a step, and those of a point.
        """
        g, d = self.graph, self.d
        F = entries(d)
        one, zero = g.const(1.0), g.const(0.0)
        H, w = ([g.input(f"{key}{name[1:]}") for name in F] for key in "Hw")
        identity = [one if i == j else zero for i in range(d) for j in range(d)]
        at = {name: g.add(h, e) for name, h, e in zip(F, H, identity, strict=True)}
        P = g.reverse(self.W, F)
        A = [g.forward(P[: e + 1], name) for e, name in enumerate(F)]  # A[e][c] = dP_c / dF_e, c <= e
        upper = [A[e][c] for c in range(d * d) for e in range(c, d * d)]
        new = g.replaced([*P, *upper], at)
        half = [g.mul(g.const(0.5), h) for h in H]
        from_rest = discrete(g, self.W, F, dict(zip(F, identity, strict=True)), dict(zip(F, half, strict=True)))
        work = g.total([g.mul(p, h) for p, h in zip(from_rest, H, strict=True)])
        step = discrete(g, self.W, F, at, dict(zip(F, w, strict=True)))
        parts = {"energy": [work], "stress": [new[p] for p in P], "tangent": [new[a] for a in upper], "step": step}
        return {key: Program(g, tuple(each)) for key, each in parts.items()}

    @cached_property
    def kept(self) -> tuple[int, ...]:
        """Operations of a step that are done at its start."""
        return self.programs["step"].kept([f"w{name[1:]}" for name in entries(self.d)])

    @cached_property
    def library(self) -> Library | None:
        """The compiled functions, or None, with a warning, where there is no compiler."""
        return compiled(Operations(self.graph, self.d, self.inputs, self.programs, self.kept))

    def inputs_at(self, H: Array, moduli: tuple[Array, ...], w: Array | None = None) -> dict[str, Array]:
        """Inputs of the programs by name."""
        d = self.d
        values = {f"H.{i}{j}": H[i, j] for i in range(d) for j in range(d)}
        if w is not None:
            values |= {f"w.{i}{j}": w[i, j] for i in range(d) for j in range(d)}
        return values | dict(zip(self.inputs, moduli, strict=True))

    def _run(self, key: str, H: Array, moduli: tuple[Array, ...], w: Array | None = None) -> Array:
        if self.library is not None and H.ndim == 3:
            return self.library.run(key, H, moduli, w)
        return self.programs[key].run(self.inputs_at(H, moduli, w), H.shape[2:])

    # ---- the interface of a law

    def energy(self, H: Array, *moduli: Array) -> Array:
        """See :class:`softgrasp.fem.strain.laws.Law`; above its value at rest."""
        return np.asarray(self._run("energy", H, moduli)[0])

    def stress(self, H: Array, *moduli: Array) -> Array:
        """See :class:`softgrasp.fem.strain.laws.Law`."""
        return self._run("stress", H, moduli).reshape(H.shape)

    def tangent(self, H: Array, *moduli: Array) -> Array:
        """See :class:`softgrasp.fem.strain.laws.Law`."""
        return symmetric_moduli(self._run("tangent", H, moduli), self.d)

    def defined(self, H: Array, *moduli: Array) -> bool:
        """Whether W is a number in all points."""
        return bool(np.isfinite(self.energy(H, *moduli)).all())

    def stiffness(self, *moduli: Array) -> Array:
        """See :class:`softgrasp.fem.strain.laws.Law`: the largest entry of the tangent at rest without its lambda.

        The pressure of a nearly incompressible law is small though lambda is large.
        """
        shape, d = np.shape(moduli[0]) if moduli else (), self.d
        A = self.at_rest(dict(zip(self.inputs, moduli, strict=True)))
        apart = np.min([A[i, i, j, j] for i in range(d) for j in range(d) if i != j], axis=0)
        A -= np.einsum("ij,km,...->ijkm...", np.eye(d), np.eye(d), np.maximum(apart, 0.0))
        return np.asarray(np.broadcast_to(np.abs(A).max(axis=(0, 1, 2, 3)), shape))

    def kernel(self, points: QuadraturePoints, moduli: tuple[Array, ...]) -> EnergyKernel | None:
        """See :class:`softgrasp.fem.strain.laws.Law`."""
        return None if self.library is None else EnergyKernel(points, moduli, self.library)

    def step(self, start: Start, half: Array, *moduli: Array) -> tuple[Array | None, Array]:
        """See :class:`softgrasp.fem.strain.laws.Law`; None also where W is no number."""
        J = 1 + volume_change(start.H + 2 * half)
        if not np.minimum.reduce(J, initial=np.inf) > 0:
            return None, J
        P = self._run("step", start.H, moduli, half).reshape(half.shape)
        return (P if np.isfinite(P).all() else None), J

    # ---- at rest

    def at_rest(self, values: dict[str, Array], by: str | None = None) -> Array:
        """Tangent (d, d, d, d, ...) at F = I, or its derivative by a parameter; ``values`` of parameters and places."""
        g, d = self.graph, self.d
        outputs = list(self.rest)
        if by is not None:
            outputs = g.forward(outputs, by)
        shape = np.broadcast_shapes(*(np.shape(x) for x in values.values()))
        return symmetric_moduli(Program(g, tuple(outputs)).run(values, shape), d)

    def stress_at_rest(self, values: dict[str, Array]) -> Array:
        """Stress (d, d, ...) at F = I."""
        g, d = self.graph, self.d
        shape = np.broadcast_shapes(*(np.shape(x) for x in values.values()))
        new = g.replaced(self.programs["stress"].outputs, self._zeros())
        outputs = tuple(new[n] for n in self.programs["stress"].outputs)
        return Program(g, outputs).run(values, shape).reshape(d, d, *shape)

    def _zeros(self) -> dict[str, int]:
        return {f"H{name[1:]}": self.graph.const(0.0) for name in entries(self.d)}

    @cached_property
    def rest(self) -> tuple[int, ...]:
        """Upper triangle of the tangent at F = I, of the parameters and places alone."""
        new = self.graph.replaced(self.programs["tangent"].outputs, self._zeros())
        return tuple(new[n] for n in self.programs["tangent"].outputs)


def symmetric_moduli(upper: Array, d: int) -> Array:
    """A (d, d, d, d, ...) from the upper triangle of its (d d, d d) rows."""
    n = d * d
    A = np.empty((n, n, *upper.shape[1:]))
    rows, columns = np.triu_indices(n)
    A[rows, columns] = upper
    A[columns, rows] = upper
    return A.reshape(d, d, d, d, *upper.shape[1:])
