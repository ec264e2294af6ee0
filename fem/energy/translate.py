"""UFL to operations: the energy W(F, parameters) of a user, on a deformation gradient of d x d entries."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import basix.ufl
import ufl
import ufl.algorithms
import ufl.algorithms.apply_algebra_lowering
import ufl.algorithms.map_integrands
import ufl.classes as nodes
from ufl.core.multiindex import FixedIndex, Index

from softgrasp.fem.energy.graph import Graph
from softgrasp.fem.errors import SceneError, shortened

CELLS = {2: "triangle", 3: "tetrahedron"}
PLACE = ("X.0", "X.1", "X.2")  # inputs for the coordinates at rest


class Parameters:
    """What W receives beside F: each parameter as an attribute, and the place at rest.

    Attributes:
        names: the parameters that the scene has; ``mu`` and ``lam`` are those of the layer's material.
        used: those that W asked for.
        x: place of the point at rest [m], a vector of d entries.
        d: number of space dimensions, 2 (plane strain) or 3.
    """

    def __init__(self, names: tuple[str, ...], domain: Any, d: int) -> None:
        self.names, self._domain, self.d = names, domain, d
        self.used: dict[str, Any] = {}
        self.x = ufl.Constant(domain, shape=(d,))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self.names:
            has = ", ".join(self.names)
            raise SceneError(f"the energy asks for the parameter '{name}'; give it in tissue.parameters (it has {has})")
        return self.used.setdefault(name, ufl.Constant(self._domain))

    __getitem__ = __getattr__


class _Lowering(ufl.algorithms.apply_algebra_lowering.LowerCompoundAlgebra):  # type: ignore[misc]
    """All compound operators in components, but for the determinant of 3 x 3 matrices."""

    def determinant(self, o: Any, A: Any) -> Any:
        return o._ufl_expr_reconstruct_(A) if A.ufl_shape == (3, 3) else super().determinant(o, A)


class Translator:
    """One energy as operations of a graph; inputs are F.00, F.01, .., the parameters by name, and X.0, X.1, ..."""

    def __init__(self, graph: Graph, terminals: dict[Any, Callable[[tuple[int, ...]], int]]) -> None:
        self.graph, self.terminals = graph, terminals
        self.known: dict[Any, int] = {}

    def scalar(self, e: Any, component: tuple[int, ...], at: dict[int, int]) -> int:
        """One component of an expression under values of its free indices."""
        key = (e, component, tuple((i, at[i]) for i in e.ufl_free_indices))
        if key not in self.known:
            self.known[key] = self._make(e, component, at)
        return self.known[key]

    def _make(self, e: Any, component: tuple[int, ...], at: dict[int, int]) -> int:
        g, ops = self.graph, e.ufl_operands
        if e in self.terminals:
            return self.terminals[e](component)
        if isinstance(e, nodes.Zero):
            return g.const(0.0)
        if isinstance(e, nodes.RealValue):
            return g.const(float(e))
        if isinstance(e, nodes.Identity):
            return g.const(float(component[0] == component[1]))
        if isinstance(e, nodes.Variable | nodes.Conj | nodes.Real):
            return self.scalar(ops[0], component, at)
        if isinstance(e, nodes.ListTensor):
            return self.scalar(ops[component[0]], component[1:], at)
        if isinstance(e, nodes.ComponentTensor):
            bound = {i.count(): c for i, c in zip(ops[1], component, strict=True)}
            return self.scalar(ops[0], (), at | bound)
        if isinstance(e, nodes.Indexed):
            fixed = tuple(int(i) if isinstance(i, FixedIndex) else at[i.count()] for i in ops[1])
            return self.scalar(ops[0], fixed, at)
        if isinstance(e, nodes.IndexSum):
            index: Index = ops[1][0]
            return g.total([self.scalar(ops[0], component, at | {index.count(): k}) for k in range(e.dimension())])
        if isinstance(e, nodes.Determinant):
            return g.det([self.scalar(ops[0], (i, j), at) for i in range(3) for j in range(3)])
        if isinstance(e, nodes.Conditional):
            a, b = (self.scalar(x, component, at) for x in ops[1:])
            return g.select(self.condition(ops[0], at), a, b)
        args = [self.scalar(x, component if isinstance(e, nodes.Sum) else (), at) for x in ops]
        return self._operation(e, args)

    def _operation(self, e: Any, args: list[int]) -> int:
        g = self.graph
        if isinstance(e, nodes.Sum):
            return g.add(*args)
        if isinstance(e, nodes.Product):
            return g.mul(*args)
        if isinstance(e, nodes.Division):
            return g.div(*args)
        if isinstance(e, nodes.Power):
            return g.power(*args)
        if isinstance(e, nodes.Abs):
            return g.sub(g.mul(g.const(2.0), g.ramp(args[0])), args[0])
        if isinstance(e, nodes.MaxValue | nodes.MinValue):
            a, b = args
            if isinstance(e, nodes.MaxValue):
                return g.add(b, g.ramp(g.sub(a, b)))
            return g.sub(b, g.ramp(g.sub(b, a)))
        names = {
            nodes.Ln: "ln", nodes.Exp: "exp", nodes.Sqrt: "sqrt", nodes.Cos: "cos", nodes.Sin: "sin", nodes.Tan: "tan",
            nodes.Cosh: "cosh", nodes.Sinh: "sinh", nodes.Tanh: "tanh", nodes.Acos: "acos", nodes.Asin: "asin",
            nodes.Atan: "atan", nodes.Erf: "erf",
        }  # fmt: skip
        if type(e) in names:
            return g.function(names[type(e)], args[0])
        raise SceneError(
            f"the energy contains {type(e).__name__} ({shortened(str(e))}); write it in F, its parameters p and p.x by "
            "sums, products, powers, det, tr, inner, ln, exp, sqrt, conditional and the like"
        )

    def condition(self, e: Any, at: dict[int, int]) -> int:
        """A condition under values of its free indices."""
        g, ops = self.graph, e.ufl_operands
        if isinstance(e, nodes.NotCondition):
            return g.compare("not", self.condition(ops[0], at))
        if isinstance(e, nodes.AndCondition | nodes.OrCondition):
            a, b = (self.condition(x, at) for x in ops)
            return g.compare("and" if isinstance(e, nodes.AndCondition) else "or", a, b)
        a, b = (self.scalar(x, (), at) for x in ops)
        if isinstance(e, nodes.GT | nodes.GE):
            a, b = b, a
        if isinstance(e, nodes.EQ | nodes.NE):
            equal = g.compare("eq", a, b)
            return equal if isinstance(e, nodes.EQ) else g.compare("not", equal)
        return g.compare("lt" if isinstance(e, nodes.LT | nodes.GT) else "le", a, b)


def entries(d: int) -> list[str]:
    """Names of the entries of F, row by row."""
    return [f"F.{i}{j}" for i in range(d) for j in range(d)]


def _parameter(graph: Graph, name: str, component: tuple[int, ...]) -> int:
    return graph.input(name)


def translate(W: Callable[[Any, Any], Any], name: str, names: tuple[str, ...], d: int) -> tuple[Graph, int, list[str]]:
    """The graph of an energy, the number of W in it, and the names of the parameters that it depends on.

    Args:
        W: energy per volume of the rest state [J/m^3] in UFL, from F and :class:`Parameters`.
        name: what messages call it.
        names: parameters that the scene has.
        d: 2 or 3.

    Raises SceneError: W fails, is no scalar in UFL, or has a part that cannot be translated.
    """
    domain = ufl.Mesh(basix.ufl.element("Lagrange", CELLS[d], 1, shape=(d,)))
    F, p = ufl.Constant(domain, shape=(d, d)), Parameters(names, domain, d)
    try:
        psi = ufl.as_ufl(W(ufl.variable(F), p))
        if psi.ufl_shape != () or psi.ufl_free_indices:
            raise SceneError(f"it has the shape {psi.ufl_shape}; it must be a scalar [J/m3]")
        psi = ufl.algorithms.map_integrands.map_integrand_dags(_Lowering(), psi)
        psi = ufl.algorithms.apply_derivatives.apply_derivatives(psi)
        psi = ufl.algorithms.map_integrands.map_integrand_dags(_Lowering(), psi)
        graph = Graph()
        terminals: dict[Any, Callable[[tuple[int, ...]], int]] = {
            F: lambda c: graph.input(f"F.{c[0]}{c[1]}"),
            p.x: lambda c: graph.input(PLACE[c[0]]),
        }
        terminals |= {constant: partial(_parameter, graph, key) for key, constant in p.used.items()}
        output = Translator(graph, terminals).scalar(psi, (), {})
    except SceneError as error:
        raise SceneError(f"{name}: {error}") from None
    except Exception as error:
        raise SceneError(
            f"{name}: the energy W(F, p) ended with {type(error).__name__}: {shortened(str(error))}"
        ) from error
    inside = {str(graph.ops[n][1][0]) for n in graph.reached([output]) if graph.ops[n][0] == "input"}
    if not inside.intersection(entries(d)):
        raise SceneError(f"{name}: the energy W(F, p) does not depend on F")
    return graph, output, [key for key in names if key in inside]
