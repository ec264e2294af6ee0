"""C of this package, compiled when it is first needed, once for a machine, into $XDG_CACHE_HOME/softgrasp."""

from __future__ import annotations

import atexit
import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from softgrasp.fem.errors import SoftgraspWarning

SHARED = Path(__file__).with_name("strain") / "law.h", Path(__file__).with_name("sum.h")  # any source may include them
LANES = 8  # points that the C code treats at a time
FLAGS = (f"-DLANES={LANES}", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")


@functools.cache
def library(
    source: Path, declaration: str, otherwise: str, headers: tuple[Path, ...] = (), defined: tuple[str, ...] = ()
) -> Any:
    """(ffi, library) of a C source; None, with a warning, where it cannot be compiled.

    Args:
        source: C file.
        declaration: of its functions, for cffi.
        otherwise: the way that is used instead, begins the warning.
        headers: files beside `SHARED` that it includes.
        defined: macros, NAME=VALUE.
    """

    def load() -> Any:
        from cffi import FFI  # it comes with FFCx, not with every online machine

        path = _shared(source, headers, tuple(f"-D{macro}" for macro in defined))
        ffi = FFI()
        ffi.cdef(declaration)
        return ffi, ffi.dlopen(str(path))

    return _or_warn(load, otherwise)


@functools.cache
def functions(source: Path, otherwise: str) -> Any:
    """The functions of a C source by ctypes, which parses no declaration; see :func:`library`."""
    return _or_warn(lambda: ctypes.CDLL(str(_shared(source, (), ()))), otherwise)


def address(array: Any) -> Any:
    """Where an array, which must stay alive, begins."""
    return ctypes.c_void_p(array.__array_interface__["data"][0])


def packed(*fields: int | Any | None) -> Any:
    """A pointer to a struct of numbers (long) and arrays (pointers, None for 0) in C; the arrays must stay alive."""
    numbers = [x if isinstance(x, int) else 0 if x is None else address(x).value for x in fields]
    return ctypes.pointer((ctypes.c_longlong * len(fields))(*numbers))


def _or_warn(load: Callable[[], Any], otherwise: str) -> Any:
    """What ``load`` returns; None, with a warning, where it cannot be compiled."""
    try:
        return load()
    except (ImportError, OSError, RuntimeError, subprocess.SubprocessError) as error:
        reason = (str(getattr(error, "stderr", "") or "") or str(error)).strip().splitlines()[:1]
        warnings.warn(
            f"{otherwise}, for want of compiled code ({''.join(reason)}); install cffi and a C compiler, or name one "
            "in CC",
            SoftgraspWarning,
            stacklevel=4,
        )
        return None


def _shared(source: Path, headers: tuple[Path, ...], macros: tuple[str, ...]) -> Path:
    """The shared library in the cache folder, made there unless it is there, named by hashes of source and machine."""
    compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise OSError("there is no C compiler")
    files = [source, *SHARED, *headers]
    folders = [f"-I{folder}" for folder in dict.fromkeys(header.parent for header in files[1:])]
    texts = *(file.read_text() for file in files), compiler, *FLAGS, *macros, _processor()
    key = hashlib.sha256("\0".join(texts).encode()).hexdigest()[:20]
    root = cache_folder()
    path = root / f"{source.stem}-{key}.so"
    if not path.exists():
        # several ranks may compile at once: each its own file, and the last one stays
        handle, name = tempfile.mkstemp(dir=root, suffix=".so")
        os.close(handle)
        command = [*compiler.split(), *FLAGS, *macros, *folders, str(source), "-o", name, "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
            os.replace(name, path)
        finally:
            Path(name).unlink(missing_ok=True)
    return path


@functools.cache
def cache_folder() -> Path:
    """Folder of what is compiled; one of this process alone where that of the user cannot be written."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "softgrasp"
    with suppress(OSError):
        root.mkdir(parents=True, exist_ok=True)
    if not os.access(root, os.W_OK):
        root = Path(tempfile.mkdtemp(prefix="softgrasp-"))
        atexit.register(shutil.rmtree, root, ignore_errors=True)
    return root


def _processor() -> str:
    """What -march=native depends on: a home folder may serve several kinds of machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        return f"{sys.platform} {platform.machine()} {platform.processor()}"
