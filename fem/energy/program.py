"""Operations as a function of arrays: by NumPy, or as C on vectors of LANES points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from softgrasp.fem.energy.graph import CONDITIONS, FUNCTIONS, Graph
from softgrasp.fem.petsc import Array

DEAR = {*FUNCTIONS, "pow"} - {"sqrt"}  # worth a place in memory from the start of a step to its trials
TINY = 1e-300  # instead of x = 0 in a quotient


def log_quotient(x: Any) -> Any:
    """log(1 + x) / x without 0/0."""
    x = x + TINY
    return np.log1p(x) / x


def exp_quotient(x: Any) -> Any:
    """(exp(x) - 1) / x without 0/0."""
    x = x + TINY
    return np.expm1(x) / x


def _det(*m: Any) -> Any:
    minors = m[4] * m[8] - m[5] * m[7], m[5] * m[6] - m[3] * m[8], m[3] * m[7] - m[4] * m[6]
    return m[0] * minors[0] + m[1] * minors[1] + m[2] * minors[2]


NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "pow": np.power, "ln": np.log,
    "exp": np.exp, "sqrt": np.sqrt, "cos": np.cos, "sin": np.sin, "tan": np.tan, "cosh": np.cosh, "sinh": np.sinh,
    "tanh": np.tanh, "acos": np.arccos, "asin": np.arcsin, "atan": np.arctan, "erf": scipy.special.erf, "lt": np.less,
    "le": np.less_equal, "eq": np.equal, "and": np.logical_and, "or": np.logical_or, "not": np.logical_not,
    "select": np.where, "ramp": lambda x: np.maximum(x, 0.0), "lnq": log_quotient, "expq": exp_quotient, "det": _det,
}  # fmt: skip
SIGNS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "==", "and": "&", "or": "|"}


@dataclass(frozen=True)
class Program:
    """Some operations of a graph."""

    graph: Graph  # all operations
    outputs: tuple[int, ...]  # numbers of the results

    def run(self, inputs: Mapping[str, Any], shape: tuple[int, ...]) -> Array:
        """The results, a row each of this shape, by NumPy, of inputs by name that have this shape or are numbers."""
        values: dict[int, Any] = {}
        with np.errstate(all="ignore"):  # what is no number is refused by those who use it
            for n in self.graph.reached(self.outputs):
                op, args = self.graph.ops[n]
                if op == "const":
                    values[n] = np.float64(args[0])
                elif op == "input":
                    values[n] = np.asarray(inputs[str(args[0])], dtype=float)
                else:
                    values[n] = NUMPY[op](*(values[int(a)] for a in args))
        result = np.empty((len(self.outputs), *shape))
        for i, n in enumerate(self.outputs):
            result[i] = values[n]
        return result

    def lines(self, reads: Mapping[str, str], kept: Sequence[int] = ()) -> list[str]:
        """C statements that compute v0, v1, .. of the operations.

        Args:
            reads: C expression of every input.
            kept: operations that are read from ``K(i)`` instead.
        """
        g, result = self.graph, []
        places = {n: i for i, n in enumerate(kept)}
        for n in self._needed(places):
            op, args = g.ops[n]
            if op == "const":
                continue
            kind = "I" if op in CONDITIONS else "V"
            if n in places:
                text = f"K({places[n]})"
            elif op == "input":
                text = reads[str(args[0])]
            else:
                text = self._text(op, [int(a) for a in args])
            result.append(f"const {kind} v{n} = {text};")
        return result

    def _needed(self, kept: Mapping[int, int]) -> list[int]:
        todo, seen = list(self.outputs), set(self.outputs)
        while todo:
            n = todo.pop()
            op, args = self.graph.ops[n]
            for a in () if n in kept or op in ("const", "input") else args:
                if a not in seen:
                    seen.add(int(a))
                    todo.append(int(a))
        return sorted(seen)

    def name(self, n: int, vector: bool = True) -> str:
        """C expression of a result; ``vector``: also where it is a number."""
        value = self.graph.value(n)
        if value is None:
            return f"v{n}"
        text = "NAN" if np.isnan(value) else f"({float(value).hex()})"
        return f"EVEN({text})" if vector else text

    def _text(self, op: str, args: list[int]) -> str:
        if op in SIGNS:
            a, b = (self.name(x, vector=False) for x in args)
            return f"{a} {SIGNS[op]} {b}" if op not in ("lt", "le", "eq") else f"(I)({a} {SIGNS[op]} {b})"
        names = ", ".join(self.name(x) for x in args)
        return f"~{names}" if op == "not" else f"v_{op}({names})"

    def kept(self, moving: Sequence[str]) -> tuple[int, ...]:
        """Costly operations that do not depend on the inputs ``moving`` and that others need."""
        g, moved = self.graph, self.graph.dependent(self.outputs, moving)
        needed = {int(a) for n in moved if g.ops[n][0] != "input" for a in g.ops[n][1]} | set(self.outputs)
        found: set[int] = set()
        todo, seen = [n for n in needed if n not in moved], set()
        while todo:  # down from where what moves meets what stays, to the first costly ones
            n = todo.pop()
            if n in seen:
                continue
            seen.add(n)
            op, args = g.ops[n]
            if op in DEAR:
                found.add(n)
            elif op not in ("const", "input"):
                todo += [int(a) for a in args]
        return tuple(sorted(found))


@dataclass(frozen=True)
class Operations:
    """What is compiled of an energy."""

    graph: Graph  # operations that the programs select from
    d: int  # space dimension
    inputs: tuple[str, ...]  # names of the numbers that a point has
    programs: dict[str, Program]  # programs by name: "energy", "stress", "tangent", "step"
    kept: tuple[int, ...]  # operations of a step that are done at its start
