"""Contact rows of a step."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array

Ints = NDArray[np.intp]
Flags = NDArray[np.bool_]


@dataclass
class Rows:
    """Contact rows of a step: a boundary node before an obstacle each, with its force."""

    obstacle: Ints  # number of the obstacle, (k,)
    node: Ints  # number of the boundary node, (k,)
    normal: Array  # mean normal of the step, (k, d)
    x: Array  # force along it [N], (k,)

    def take(self, on: Flags) -> Self:
        """Those of the rows that are ``on``, (k,)."""
        return type(self)(*(getattr(self, field.name)[on] for field in fields(self)))

    def forces(self) -> Array:
        """Forces on the nodes, (k, d) [N]."""
        return self.x[:, None] * self.normal
