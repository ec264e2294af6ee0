"""Compile what a first run would wait for, forms of P1 to P4 and products of a step: `python tools/compile_forms.py`.

The forms depend on dimension, order and whether there are layers, on nothing else; P3 is compared with P4 on its mesh.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context


def compile_forms(job: tuple[int, int, bool]) -> None:
    """Build a body of few cells in d dimensions with elements of an order, in one material or with a layer."""
    from mpi4py import MPI

    import softgrasp as sg
    from softgrasp.fem.scene.scene import Scene

    d, order, layered = job
    material = {"lambda": 50.0, "mu": 50.0, "rho": 1.0}
    box = [[0.0] * d, [1.0] * (d - 1) + [0.5]]
    tissue = {"size": [1.0] * d, "cells": [1] * (d - 1) + [2], "material": material}
    if layered:
        tissue["layers"] = {"low": {"box": box, "material": material}}
    contact = {"sides": ["top" if d == 2 else "z+"], "box": [[0.0] * d, [1.0] * d]}
    scene = Scene.model_validate(
        {"name": "forms", "tissue": tissue, "contact": contact, "time": {"steps": 1, "end": 1.0}}
    )
    sg.build(scene.model_copy(update={"tissue": scene.tissue.model_copy(update={"order": order})}), comm=MPI.COMM_SELF)


def main() -> None:
    """Two at a time, each in a process of its own that ends with its work."""
    from softgrasp.fem.solve.differences import product_code

    product_code()
    jobs = list(product((2, 3), (1, 2, 3, 4), (False, True)))
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(compile_forms, sorted(jobs, key=lambda job: (job[2], job[0], job[1]))))


if __name__ == "__main__":
    sys.exit(main())
