"""Pictures drawn by a forked process while this one goes on computing."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from mpi4py import MPI

from softgrasp.fem import note
from softgrasp.fem.forked import forked

Draw = Callable[[Path], list[Path]]


def draw_in_background(comm: MPI.Intracomm, out: Path, draw: Draw) -> Callable[[], list[Path]]:
    """Begin to draw into ``out``; the function returned waits for the files and names them on rank 0. Not collective.

    Without another process, see :func:`forked`, the pictures are drawn when they are asked for.

    Raises (when they are asked for):
        Exception: what ``draw`` raised.
    """
    if comm.rank != 0:
        return list
    folder = TemporaryDirectory(prefix="softgrasp-")
    begun = forked(lambda pause: draw(Path(folder.name)))
    if begun is None:
        folder.cleanup()
        return partial(draw, out)

    def files() -> list[Path]:
        try:
            done = begun.result()
        except OSError:  # perhaps there is room in the folder itself
            return draw(out)
        out.mkdir(parents=True, exist_ok=True)
        with folder:
            note(*(out / file.name for file in done))
            return [Path(shutil.move(file, out / file.name)) for file in done]

    return files
