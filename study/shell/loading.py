"""What a command does while its modules load: leave out what it does not use, and end at Ctrl-C.

Imports nothing but the standard library, so that it can come first.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import os
import signal
import sys
from collections.abc import Iterator
from types import FrameType

PLUGINS = "PYDANTIC_DISABLE_PLUGINS"  # variable of the environment
UNUSED = ("f2py", "ma", "testing")  # parts of numpy that SciPy loads to copy their names


def quiet_imports() -> None:
    """Let Ctrl-C end the program at once while modules load, where KeyboardInterrupt would tear compiled ones apart.

    Leaves any handler but Python's own alone.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    outer = frame
    while outer is not None:
        if outer.f_code.co_filename == "<frozen importlib._bootstrap>":
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        outer = outer.f_back
    signal.default_int_handler(number, frame)


_lasting = False  # whether garbage collections leave imports out


def lasting_imports() -> None:
    """Keep what `loading` imports out of garbage collections, for a program that is one command (0.4 s of its time).

    What is left at the end is not looked through either; modules and their objects are freed as ever.
    """
    global _lasting
    _lasting = True
    atexit.register(gc.freeze)


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Import here what computes: without garbage collections, and without the parts of numpy that nothing here uses.

    numpy loads those when somebody asks for them. Pydantic does not look for plugins, which would read the metadata of
    all installed packages, unless PYDANTIC_DISABLE_PLUGINS is set; child programs inherit no such variable.
    """
    collects, given = gc.isenabled(), PLUGINS in os.environ
    gc.disable()
    os.environ.setdefault(PLUGINS, "__all__")
    try:
        _load_scipy()
        yield
    finally:
        if not given:
            os.environ.pop(PLUGINS, None)
        if collects:
            if _lasting:
                gc.freeze()
            gc.enable()


def _load_scipy() -> None:
    import numpy  # noqa: ICN001  (the command line alone needs none)

    left_out = [name for name in UNUSED if name not in vars(numpy)]
    for name in left_out:
        setattr(numpy, name, None)
    try:
        importlib.import_module("scipy.sparse")
    finally:
        copies = [module for name, module in list(sys.modules.items()) if name.endswith("array_api_compat.numpy")]
        for module in (numpy, *copies):
            for name in left_out:
                if vars(module).get(name, module) is None:
                    delattr(module, name)
