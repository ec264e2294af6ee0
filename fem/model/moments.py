"""Assembly of the integrals that only the frame of a turning hand needs."""

from __future__ import annotations

import dolfinx.fem
import numpy as np
import ufl

from softgrasp.fem.frame.integrals import FrameIntegrals
from softgrasp.fem.model.assembly import Discretisation, Inventory
from softgrasp.fem.scene.scene import Scene


def frame_integrals(space: Discretisation, scene: Scene, inventory: Inventory) -> FrameIntegrals:
    """Integrals int phi_k r_l of each layer by one compiled form, int v . (A r) dx with A = e_k e_l'. Collective."""
    d, domain = space.layout.dimension, space.mesh.mesh
    A = dolfinx.fem.Constant(domain, np.zeros((d, d)))
    center = dolfinx.fem.Constant(domain, np.array(space.layout.reference))
    r, v = ufl.SpatialCoordinate(domain) - center, ufl.TestFunction(space.V)
    inventory.forms.append("S")
    parts = []
    for i, name in enumerate(space.layers):
        cells = np.flatnonzero(space.layer == i).astype(np.int32)
        dx = ufl.Measure("dx", domain=domain, subdomain_data=[(1, cells)])(1) if scene.tissue.layers else ufl.dx(domain)
        form = dolfinx.fem.form(ufl.inner(A * r, v) * dx)
        part = np.zeros((space.layout.n_local, d * d), order="F")
        for j in range(d * d):
            A.value[:] = 0.0
            A.value[j // d, j % d] = scene.tissue.thickness
            b = dolfinx.fem.assemble_vector(form)
            b.scatter_reverse(dolfinx.la.InsertMode.add)
            part[:, j] = b.array.reshape(-1, d)[space.free].ravel()
        parts.append(part)
        inventory.operators.append(f"S[{name}]")
    return FrameIntegrals(tuple(parts))
