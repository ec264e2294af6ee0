"""How a command ends: one sentence and status 1 for a user's error; what only one rank meets ends all ranks."""

from __future__ import annotations

import os
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from softgrasp.fem import SceneError, SoftgraspError, one_line
from softgrasp.fem.errors import SoftgraspWarning
from softgrasp.study.shell.streams import outlive_readers, write_utf8

RANK = ("PMI_RANK", "PMIX_RANK", "OMPI_COMM_WORLD_RANK")  # set by launchers, known before MPI is loaded
PREFIXES = "docs/guide/petsc.md"
PIPED = 120  # letters of a line that no terminal shows


def rank() -> int:
    """Rank of this process, without loading MPI."""
    if "mpi4py.MPI" in sys.modules:
        from mpi4py import MPI

        return int(MPI.COMM_WORLD.rank)
    return next((int(os.environ[name]) for name in RANK if os.environ.get(name, "").isdigit()), 0)


def console() -> Console:
    """A console that writes on rank 0 only; as wide as the terminal, or 120 letters into a file or pipe."""
    shown = Console(quiet=rank() != 0, highlight=False)
    if not shown.is_terminal and "COLUMNS" not in os.environ:
        shown.width = PIPED
    return shown


def end_all() -> None:
    """End the other ranks, which may wait for this one."""
    sys.stderr.flush()
    if "mpi4py.MPI" not in sys.modules:
        return
    from mpi4py import MPI

    if MPI.COMM_WORLD.size > 1:
        time.sleep(0.5)  # the launcher must have passed the text on before it ends
        MPI.COMM_WORLD.Abort(1)


def check_words(words: Sequence[str]) -> None:
    """Raise SceneError for what DOLFINx, which looks at all arguments, and Python could not read as text."""
    for word in words:
        if not word.isascii() and any("\ud800" <= letter <= "\udfff" for letter in word):
            raise SceneError(f"{word}: this argument is not text here; rename the file or set LC_ALL=C.UTF-8")


def no_compiler(error: BaseException) -> str:
    """A sentence where DOLFINx could not compile a form for want of a C compiler, else nothing."""
    if type(error).__module__.partition(".")[0] == "cffi" or "JIT compilation" in str(error):
        last = (str(error).strip().splitlines() or [""])[-1]
        return one_line(
            f"a form cannot be compiled ({last}); install a C compiler or name one in CC, see softgrasp doctor"
        )
    return ""


def name_unused_options() -> None:
    """Warn of PETSc options for this program that no solver read, and keep PETSc from listing them again."""
    petsc = sys.modules.get("petsc4py.PETSc")
    if petsc is None:
        return
    options = petsc.Options()
    unused = [name for name in options.getAll() if name.startswith("softgrasp_") and not options.used(name)]
    for name in unused:
        options.hasName(name)  # marks it as used
    if unused and rank() == 0:
        names = ", ".join(f"-{name}" for name in unused)
        sys.stderr.write(
            f"warning: no solver of this command read {names} of PETSC_OPTIONS; {PREFIXES} lists the prefixes\n"
        )


def write_warning(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
    """One sentence on rank 0 for a warning of this package, as for its errors; others with file and line."""
    if not issubclass(category, SoftgraspWarning):
        sys.stderr.write(warnings.formatwarning(message, category, *place[:2]))
    elif rank() == 0:
        sys.stderr.write(f"warning: {one_line(str(message))}\n")


def run_command(command: Callable[[], object]) -> None:
    """Run a command line to its end. Collective."""
    outlive_readers()
    write_utf8()
    warnings.showwarning = write_warning
    try:
        check_words(sys.argv)
        command()
    except SoftgraspError as error:
        if rank() == 0:
            Console(stderr=True, highlight=False).print(Text(f"error: {error}"), soft_wrap=True)
        sys.exit(1)
    except (SystemExit, KeyboardInterrupt):
        raise
    except OSError as error:  # a folder that cannot be made, a full disk: of one rank, so it must end all
        name = f"{error.filename}: " if error.filename else ""
        reason = one_line(f"{name}{error.strerror or error}; check --out, its permissions and the free disk")
        sys.stderr.write(f"error: {reason}\n")
        end_all()
        sys.exit(1)
    except BaseException as error:
        if reason := no_compiler(error):  # DOLFINx raises it on all ranks
            sys.stderr.write(f"error: {reason}\n" * (rank() == 0))
            sys.exit(1)
        traceback.print_exc()
        end_all()
        sys.exit(2)
    finally:
        name_unused_options()
