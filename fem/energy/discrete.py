"""The stress of a step that does exactly the work W(F_1) - W(F_0), by a chain rule for difference quotients.

The discrete derivative of W over a step from F_0 to F_1 follows the operations of W backwards, as the derivative does,
with the difference quotient of each operation in the place of its slope:

    D(a b) = mean(a) Db + mean(b) Da,   D(1/b) = -Db / (b_0 b_1),   D f(x) = (f(x_1) - f(x_0)) / (x_1 - x_0) Dx,
    D det M = (Cof mean(M) + Cof(DM) / 12) : DM in 3D,

so P : (F_1 - F_0) = W_1 - W_0 holds to rounding however small the step, P = 2 mean(F) S if W depends on C = F'F alone,
and for neo-Hooke and St. Venant-Kirchhoff P is what `softgrasp.fem.strain.laws` has [G96, ST92]. Quotients of ln, exp
and powers have no difference in the denominator; those of other functions are the mean of three Gauss points of f'
where x_1 - x_0 is small. Where a condition on F changes its answer between the ends, Gonzalez' correction closes the
balance, P + (W_1 - W_0 - P : DF) DF / |DF|^2 [G96].
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from softgrasp.fem.energy.graph import CONDITIONS, Graph

CLOSE = 1e-2  # |x_1 - x_0| below which three Gauss points have f' to rounding, and above which the quotient has [1]
GAUSS = ((-math.sqrt(0.6), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.6), 5 / 18))


def discrete(graph: Graph, output: int, names: Sequence[str], begin: dict[str, int], half: dict[str, int]) -> list[int]:
    """Discrete derivatives of an output by the inputs ``names`` over a step.

    Args:
        begin: value of each of them at the beginning.
        half: half its change.
    """
    g, ends = graph, Ends(graph, output, names, begin, half)
    P = g.backwards(output, names, ends.quotients)
    if not ends.switched:
        return P
    change = [g.mul(g.const(2.0), half[name]) for name in names]
    work = g.total([g.mul(p, x) for p, x in zip(P, change, strict=True)])
    size = g.total([g.mul(x, x) for x in change])
    left = g.sub(g.sub(ends.last[output], ends.first[output]), work)
    switched = ends.switched[0]
    for condition in ends.switched[1:]:
        switched = g.compare("or", switched, condition)
    some = g.compare("and", switched, g.compare("lt", g.const(0.0), size))
    factor = g.select(some, g.div(left, g.select(some, size, g.const(1.0))), g.const(0.0))
    return [g.add(p, g.mul(factor, x)) for p, x in zip(P, change, strict=True)]


class Ends:
    """The operations of an output at both ends of a step, and the difference quotient of each.

    Attributes:
        first: number of each operation at the beginning of the step, by its number.
        last: the same at its end.
        switched: conditions that hold where a condition changes its answer over the step.
    """

    def __init__(
        self, graph: Graph, output: int, names: Sequence[str], begin: dict[str, int], half: dict[str, int]
    ) -> None:
        self.graph, g = graph, graph
        self.first = g.replaced([output], begin)
        self.last: dict[int, int] = {}
        self.switched: list[int] = []
        self._quotients: dict[int, list[tuple[int, int]]] = {}
        moved = g.dependent([output], names)
        for n in g.reached([output]):
            op, args = g.ops[n]
            if n not in moved:
                self.last[n] = self.first[n]
            elif op == "input":
                name = str(args[0])
                self.last[n] = g.add(begin[name], g.mul(g.const(2.0), half[name]))
            elif op in ("ln", "exp"):  # from the first value: no second call of the library, and the same quotient
                a = int(args[0])
                (_, q), x = self._found(n)[0], g.sub(self.last[a], self.first[a])
                self.last[n] = g.add(self.first[n], g.mul(q, x))
            else:
                self.last[n] = g.apply(op, [self.last[int(a)] for a in args])
            if op in CONDITIONS and n in moved:
                one, two = self.first[n], self.last[n]
                self.switched.append(
                    g.compare("or", g.compare("and", one, g.compare("not", two)),
                              g.compare("and", two, g.compare("not", one)))
                )  # fmt: skip

    def quotients(self, n: int) -> list[tuple[int, int]]:
        """Arguments of an operation, each with its difference quotient."""
        return self._found(n)

    def _found(self, n: int) -> list[tuple[int, int]]:
        if n not in self._quotients:
            self._quotients[n] = self._make(n)
        return self._quotients[n]

    def _mean(self, n: int) -> int:
        g, a, b = self.graph, self.first[n], self.last[n]
        return a if a == b else g.mul(g.const(0.5), g.add(a, b))

    def _make(self, n: int) -> list[tuple[int, int]]:
        g = self.graph
        op, raw = g.ops[n]
        if op in ("const", "input", *CONDITIONS):
            return []
        args, one = [int(a) for a in raw], g.const(1.0)
        a, b = args[0], args[-1]
        if op in ("add", "sub"):
            return g.slopes(n)
        if op == "mul":
            return [(a, self._mean(b)), (b, self._mean(a))]
        if op == "div":
            r0, r1 = g.div(one, self.first[b]), g.div(one, self.last[b])
            mean = g.mul(g.const(0.5), g.add(r0, r1))
            return [(a, mean), (b, g.mul(g.mul(g.const(-1.0), self._mean(a)), g.mul(r0, r1)))]
        if op == "select":
            at, zero = self.last[a], g.const(0.0)
            return [(args[1], g.select(at, one, zero)), (args[2], g.select(at, zero, one))]
        if op == "det":
            means = [self._mean(x) for x in args]
            change = [g.sub(self.last[x], self.first[x]) for x in args]
            bent = [g.mul(g.const(1 / 12), c) for c in g.cofactor(change)]
            return [(x, g.add(c, e)) for x, c, e in zip(args, g.cofactor(means), bent, strict=True)]
        if op == "pow":
            return self._power(n, a, b)
        if op == "ramp":
            return [(a, self._ramp(self.first[a], self.last[a]))]
        return [(a, self._function(op, a))]

    def _ramp(self, x0: int, x1: int) -> int:
        """1 or 0 where both values have one sign; else the share of the way that lies above 0."""
        g, zero, one = self.graph, self.graph.const(0.0), self.graph.const(1.0)
        if x0 == x1:
            return g.select(g.compare("lt", zero, x0), one, zero)
        up, down = (g.compare("lt", zero, x) for x in (x1, x0))
        both, some = g.compare("and", up, down), g.compare("or", up, down)
        change = g.sub(x1, x0)
        mixed = g.compare("and", some, g.compare("not", both))
        share = g.div(g.sub(g.ramp(x1), g.ramp(x0)), g.select(mixed, change, one))
        return g.select(mixed, share, g.select(both, one, zero))

    def _power(self, n: int, a: int, b: int) -> list[tuple[int, int]]:
        """Of x^y: first x changes at the first y, then y at the last x."""
        g = self.graph
        x0, x1, y0, y1 = self.first[a], self.last[a], self.first[b], self.last[b]
        log, t = g.function("ln", x0), g.div(g.sub(x1, x0), x0)
        q = g.apply("lnq", [t])
        by = g.div(g.mul(g.mul(g.power(x0, y0), y0), g.mul(g.apply("expq", [g.mul(y0, g.mul(q, t))]), q)), x0)
        if y0 == y1:
            return [(a, by)]
        log1 = g.add(log, g.mul(q, t))
        change = g.mul(log1, g.sub(y1, y0))
        return [(a, by), (b, g.mul(g.mul(g.power(x1, y0), log1), g.apply("expq", [change])))]

    def _function(self, op: str, a: int) -> int:
        g = self.graph
        x0, x1 = self.first[a], self.last[a]
        if x0 == x1:
            return g.slope(op, x0)
        x = g.sub(x1, x0)
        if op == "ln":
            return g.div(g.apply("lnq", [g.div(x, x0)]), x0)
        if op == "exp":
            return g.mul(g.function("exp", x0), g.apply("expq", [x]))
        if op == "sqrt":
            return g.div(g.const(1.0), g.add(g.function("sqrt", x0), g.function("sqrt", x1)))
        middle, half = g.mul(g.const(0.5), g.add(x0, x1)), g.mul(g.const(0.5), x)
        points = [(g.add(middle, g.mul(g.const(s), half)), w) for s, w in GAUSS]
        mean = g.total([g.mul(g.const(w), g.slope(op, at)) for at, w in points])
        small = g.compare("lt", g.mul(x, x), g.const(CLOSE**2))
        quotient = g.div(g.sub(g.function(op, x1), g.function(op, x0)), g.select(small, g.const(1.0), x))
        return g.select(small, mean, quotient)
