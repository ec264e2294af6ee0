"""Scalar expressions as a list of operations, each kept once, with derivatives that are operations again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

type Op = tuple[str, tuple[int | float | str, ...]]

FUNCTIONS = ("ln", "exp", "sqrt", "cos", "sin", "tan", "cosh", "sinh", "tanh", "acos", "asin", "atan", "erf")
CONDITIONS = ("lt", "le", "eq", "and", "or", "not")


class Graph:
    """Operations in an order in which they can be computed.

    Attributes:
        ops: name and arguments of each operation: numbers of others, or the value of a constant, the name of an input.
    """

    def __init__(self) -> None:
        self.ops: list[Op] = []
        self._numbers: dict[Op, int] = {}

    def _put(self, op: str, *args: int | float | str) -> int:
        key = op, args
        if key not in self._numbers:
            self._numbers[key] = len(self.ops)
            self.ops.append(key)
        return self._numbers[key]

    def const(self, value: float) -> int:
        """A number."""
        return self._put("const", float(value) + 0.0)  # no -0.0

    def input(self, name: str) -> int:
        """A value that is given, by its name."""
        return self._put("input", name)

    def value(self, a: int) -> float | None:
        """The value of a constant, else None."""
        op, args = self.ops[a]
        return float(args[0]) if op == "const" else None

    def add(self, a: int, b: int) -> int:
        """A + b."""
        x, y = self.value(a), self.value(b)
        if x is not None and y is not None:
            return self.const(x + y)
        if x == 0:
            return b
        return a if y == 0 else self._put("add", *sorted((a, b)))

    def sub(self, a: int, b: int) -> int:
        """A - b."""
        x, y = self.value(a), self.value(b)
        if x is not None and y is not None:
            return self.const(x - y)
        if a == b:
            return self.const(0.0)
        return a if y == 0 else self._put("sub", a, b)

    def mul(self, a: int, b: int) -> int:
        """A b."""
        x, y = self.value(a), self.value(b)
        if x is not None and y is not None:
            return self.const(x * y)
        if x == 0 or y == 0:
            return self.const(0.0)
        if x == 1:
            return b
        return a if y == 1 else self._put("mul", *sorted((a, b)))

    def div(self, a: int, b: int) -> int:
        """A / b."""
        x, y = self.value(a), self.value(b)
        if y is not None and y != 0:
            return self.mul(a, self.const(1 / y)) if x is None else self.const(x / y)
        if x == 0:
            return a
        return self._put("div", a, b)

    def total(self, terms: Sequence[int]) -> int:
        """Sum of all."""
        result = self.const(0.0)
        for term in terms:
            result = self.add(result, term)
        return result

    def power(self, a: int, b: int) -> int:
        """A^b; by products where b is a small whole number."""
        x, y = self.value(a), self.value(b)
        if y is None:
            return self._put("pow", a, b)
        if x is not None and (x > 0 or y == int(y)) and (x != 0 or y >= 0):
            return self.const(x**y)
        if y == 0.5:
            return self.function("sqrt", a)
        if y < 0:
            return self.div(self.const(1.0), self.power(a, self.const(-y)))
        if y == int(y) and y <= 16:
            result, square, n = self.const(1.0), a, int(y)
            while n:
                result = self.mul(result, square) if n & 1 else result
                n >>= 1
                square = self.mul(square, square) if n else square
            return result
        return self._put("pow", a, b)

    def function(self, name: str, a: int) -> int:
        """F(a) of :data:`FUNCTIONS`."""
        x = self.value(a)
        if x is not None:
            own = {"ln": math.log}.get(name) or getattr(math, name)
            try:
                return self.const(own(x))
            except ValueError:
                return self.const(math.nan)
        return self._put(name, a)

    def compare(self, op: str, *args: int) -> int:
        """A condition, 1 or 0; for "lt", "le", "eq" of two values, for "and", "or", "not" of conditions."""
        values = [self.value(a) for a in args]
        if None not in values:
            x, y = (float(v) for v in (values[0] or 0.0, values[-1] or 0.0))
            answers = {
                "lt": x < y, "le": x <= y, "eq": x == y, "and": bool(x and y), "or": bool(x or y), "not": not x,
            }  # fmt: skip
            return self.const(float(answers[op]))
        if op in ("and", "or"):
            for first, other, known in ((args[0], args[1], values[0]), (args[1], args[0], values[1])):
                if known is not None:
                    return other if bool(known) == (op == "and") else first
            if args[0] == args[1]:
                return args[0]
        return self._put(op, *args)

    def select(self, c: int, a: int, b: int) -> int:
        """A where the condition c holds, else b."""
        known = self.value(c)
        if known is not None:
            return a if known else b
        return a if a == b else self._put("select", c, a, b)

    def ramp(self, a: int) -> int:
        """The larger of a and 0."""
        x = self.value(a)
        return self._put("ramp", a) if x is None else self.const(max(x, 0.0))

    def det(self, entries: Sequence[int]) -> int:
        """Determinant of a 3 x 3 matrix, row by row: one operation, whose discrete derivative has no preferred row."""
        if all(self.value(a) is not None for a in entries):
            m = [float(self.value(a) or 0.0) for a in entries]
            return self.const(
                m[0] * (m[4] * m[8] - m[5] * m[7])
                - m[1] * (m[3] * m[8] - m[5] * m[6])
                + m[2] * (m[3] * m[7] - m[4] * m[6])
            )
        return self._put("det", *entries)

    def cofactor(self, m: Sequence[int]) -> list[int]:
        """Cof M of a 3 x 3 matrix, row by row."""
        result = []
        for i in range(3):
            for k in range(3):
                a, b, n, o = 3 * ((i + 1) % 3), 3 * ((i + 2) % 3), (k + 1) % 3, (k + 2) % 3
                result.append(self.sub(self.mul(m[a + n], m[b + o]), self.mul(m[a + o], m[b + n])))
        return result

    def apply(self, op: str, args: Sequence[int]) -> int:
        """The operation of this name on other arguments."""
        if op == "select":
            return self.select(*args)
        if op in CONDITIONS:
            return self.compare(op, *args)
        if op == "det":
            return self.det(args)
        if op in FUNCTIONS:
            return self.function(op, args[0])
        if op == "ramp":
            return self.ramp(args[0])
        if op in ("lnq", "expq"):
            return self._put(op, *args)
        ways: dict[str, Callable[[int, int], int]] = {
            "add": self.add, "sub": self.sub, "mul": self.mul, "div": self.div, "pow": self.power,
        }  # fmt: skip
        return ways[op](*args)

    # ---- what depends on what

    def reached(self, outputs: Sequence[int]) -> list[int]:
        """Numbers of the operations that the outputs need, ascending."""
        todo, seen = list(outputs), set(outputs)
        while todo:
            op, args = self.ops[todo.pop()]
            for a in () if op in ("const", "input") else args:
                if a not in seen:
                    seen.add(int(a))
                    todo.append(int(a))
        return sorted(seen)

    def dependent(self, outputs: Sequence[int], names: Sequence[str]) -> set[int]:
        """Those of the operations that the outputs need which depend on one of these inputs."""
        found: set[int] = set()
        for n in self.reached(outputs):
            op, args = self.ops[n]
            if (op == "input" and args[0] in names) or (op not in ("const", "input") and found.intersection(args)):
                found.add(n)
        return found

    def replaced(self, outputs: Sequence[int], given: dict[str, int]) -> dict[int, int]:
        """The same operations with other values of some inputs: number of the new operation by that of the old."""
        new: dict[int, int] = {}
        for n in self.reached(outputs):
            op, args = self.ops[n]
            if op == "input":
                new[n] = given.get(str(args[0]), n)
            else:
                new[n] = n if op == "const" else self.apply(op, [new[int(a)] for a in args])
        return new

    # ---- derivatives

    def slopes(self, n: int) -> list[tuple[int, int]]:
        """Arguments of an operation, each with the derivative by it."""
        op, raw = self.ops[n]
        if op in ("const", "input", *CONDITIONS):
            return []
        args, one = [int(a) for a in raw], self.const(1.0)
        a, b = args[0], args[-1]
        if op in ("add", "sub"):
            return [(a, one), (b, one if op == "add" else self.const(-1.0))]
        if op == "mul":
            return [(a, b), (b, a)]
        if op == "div":
            return [(a, self.div(one, b)), (b, self.mul(self.const(-1.0), self.div(n, b)))]
        if op == "pow":
            by = self.mul(b, self.power(a, self.sub(b, one)))
            return [(a, by), (b, self.mul(n, self.function("ln", a)))]
        if op == "select":
            zero = self.const(0.0)
            return [(args[1], self.select(a, one, zero)), (args[2], self.select(a, zero, one))]
        if op == "det":
            return list(zip(args, self.cofactor(args), strict=True))
        if op == "ramp":
            return [(a, self.select(self.compare("lt", self.const(0.0), a), one, self.const(0.0)))]
        return [(a, self.slope(op, a))]

    def slope(self, op: str, a: int) -> int:
        """F'(a) of a function."""
        one, f = self.const(1.0), self.function(op, a)
        square, minus = self.mul(a, a), self.const(-1.0)
        rules: dict[str, Callable[[], int]] = {
            "ln": lambda: self.div(one, a), "exp": lambda: f, "sqrt": lambda: self.div(self.const(0.5), f),
            "cos": lambda: self.mul(minus, self.function("sin", a)), "sin": lambda: self.function("cos", a),
            "tan": lambda: self.add(one, self.mul(f, f)), "cosh": lambda: self.function("sinh", a),
            "sinh": lambda: self.function("cosh", a), "tanh": lambda: self.sub(one, self.mul(f, f)),
            "acos": lambda: self.div(minus, self.function("sqrt", self.sub(one, square))),
            "asin": lambda: self.div(one, self.function("sqrt", self.sub(one, square))),
            "atan": lambda: self.div(one, self.add(one, square)),
            "erf": lambda: self.mul(self.const(2 / math.sqrt(math.pi)), self.function("exp", self.mul(minus, square))),
        }  # fmt: skip
        return rules[op]()

    def forward(self, outputs: Sequence[int], name: str) -> list[int]:
        """Derivatives of the outputs by one input."""
        d: dict[int, int] = {}
        moved, zero = self.dependent(outputs, (name,)), self.const(0.0)
        for n in sorted(moved):
            if self.ops[n][0] == "input":
                d[n] = self.const(1.0)
            else:
                d[n] = self.total([self.mul(s, d[a]) for a, s in self.slopes(n) if a in d])
        return [d.get(n, zero) for n in outputs]

    def reverse(self, output: int, names: Sequence[str]) -> list[int]:
        """Derivatives of one output by the inputs."""
        return self.backwards(output, names, self.slopes)

    def backwards(self, output: int, names: Sequence[str], slopes: Callable[[int], list[tuple[int, int]]]) -> list[int]:
        """The chain rule from one output back to inputs, ``slopes`` as :meth:`slopes`."""
        moved = self.dependent([output], names)
        terms: dict[int, list[int]] = {output: [self.const(1.0)]}
        result = {name: self.const(0.0) for name in names}
        for n in sorted(moved, reverse=True):
            own = self.total(terms.get(n, []))
            if self.ops[n][0] == "input":
                result[str(self.ops[n][1][0])] = own
                continue
            for a, s in slopes(n):
                if a in moved:
                    terms.setdefault(a, []).append(self.mul(own, s))
        return [result[name] for name in names]
