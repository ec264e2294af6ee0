"""Simulate a rigid robot hand that holds soft tissue, reduce the model, and control it optimally.

The names below are loaded when they are used first; until then neither MPI nor DOLFINx is.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before numpy: ranks share the cores
    os.environ.setdefault(_variable, "1")

PACKAGE = Path(__file__).parent
"""Folder of the package; in a checkout its subpackages are links to the folders beside it."""


def package_version() -> str:
    """Version of the installed distribution, or "source" in a bare checkout. Not collective."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("softgrasp")
    except PackageNotFoundError:
        return "source"


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return package_version()
    raise AttributeError(f"module 'softgrasp' has no attribute {name!r}")
