"""Threads of an OpenBLAS that was loaded before softgrasp, by `import numpy` above it: it read no variable of ours."""

from __future__ import annotations

import ctypes
from pathlib import Path

MAPS = Path("/proc/self/maps")  # what is loaded; Linux
NAMES = [f"{prefix}openblas_set_num_threads{suffix}" for prefix in ("scipy_", "") for suffix in ("64_", "")]


def one_thread() -> None:
    """Every OpenBLAS of this process gets one thread, as OPENBLAS_NUM_THREADS=1 gives to one that is loaded later."""
    lines = MAPS.read_text().splitlines() if MAPS.exists() else []
    for path in {line.split(maxsplit=5)[-1] for line in lines if "openblas" in line}:
        try:
            library = ctypes.CDLL(path)
        except OSError:  # removed since, or no library
            continue
        for name in NAMES:
            if hasattr(library, name):
                getattr(library, name)(1)
                break
