"""One command in progress: the scene and its size at the start, progress, result.json, tables and page at the end."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict

from mpi4py import MPI
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
from rich.text import Text

from softgrasp.fem import Model, Scene, build, find_scene, follow, load_scene_collective, raise_on_all_ranks
from softgrasp.study.report import Page, Table, command_line, show_sections, write_json, write_report, write_scene
from softgrasp.study.shell.folder import claim, files_of, read_result, remove_files


class Flags(TypedDict, total=False):
    """Options of every command beside its own, see :class:`Session`."""

    quiet: bool
    pictures: bool
    empty: bool


@dataclass(frozen=True)
class Session:
    """What a command was called with."""

    command: str  # name of the command
    path: Path  # scene file
    overrides: Sequence[str]  # arguments of ``--set``
    out: Path  # folder of the results
    console: Console  # writes on rank 0 only
    quiet: bool = False  # no progress bars
    pictures: bool = True  # whether pictures are drawn
    empty: bool = False  # remove what an earlier run has left in the folder
    writes: bool = True  # False: print only
    begin: float = field(default_factory=time.perf_counter)  # [s]
    notes: list[str] = field(default_factory=list)  # what the mesh warns of, printed when the model was built

    @property
    def comm(self) -> MPI.Intracomm:
        """Ranks that run the command."""
        return MPI.COMM_WORLD

    def scene(self, beside: Sequence[Path] = ()) -> Scene:
        """Load the scene file, claim the folder, and print name and description. Collective.

        ``beside``: further files that the command reads.

        Raises SceneError: the file or a key is wrong, or the folder holds another run.
        """
        scene = load_scene_collective(self.comm, self.path, self.overrides)
        self.claim(scene.name, lambda: [find_scene(self.path), *scene.files, *beside])
        described = f": {escape(scene.description)}" if scene.description else ""
        self.console.print(f"[bold]{escape(scene.name)}[/bold]{described}", soft_wrap=True)
        return scene

    def claim(self, name: str, inputs: Callable[[], Iterable[Path]]) -> None:
        """Lock the folder for a run of this name, which reads these files. Collective.

        Raises SceneError: see :func:`softgrasp.study.shell.folder.claim`.
        """
        if not self.writes:
            return
        with raise_on_all_ranks(self.comm):
            if self.comm.rank == 0:
                claim(self.out, self.command, name, inputs=inputs(), empty=self.empty)
        follow(self.out)

    def model(self, scene: Scene, steps: bool = True) -> Model:
        """Build a scene and print its size and what its mesh warns of. Collective.

        ``steps``: refuse a tolerance of its mesh that its time steps cannot carry. Raises SoftgraspError.
        """
        if scene.tissue.refine is None:
            model = build(scene, comm=self.comm)
        else:
            from softgrasp.fem.accuracy import adapt  # only scenes with graded cells pay for it

            model = adapt.build(scene, comm=self.comm, steps=steps)
        layout = model.system.layout
        self.console.print(f"n_s = {layout.n_s}, n_e = {layout.n_e}, 2n = {layout.states}, {layout.comm.size} rank(s)")
        self.notes.extend(model.space.mesh.notes)
        show_warnings(self.console, self.notes)
        return model

    def progress(self, count: ProgressColumn) -> Progress:
        """Bars with the time left, in a terminal only."""
        return progress_bar(self.console, count, quiet=self.quiet)

    @contextmanager
    def counting(self, what: str) -> Iterator[Callable[[str, int, int], None]]:
        """One bar for several things in turn, called with what is done, its number and how many there are."""
        with self.progress(MofNCompleteColumn()) as bar:
            task = bar.add_task(what, total=None)
            yield lambda what, done, of: bar.update(task, description=what, completed=done, total=of)

    def keep(self, scene: Scene, result: dict[str, Any], tables: Mapping[str, Table]) -> None:
        """Write result.json, scene.toml and tables before work that may fail; `write` replaces them. Collective.

        Raises OSError on all ranks: the folder cannot be written.
        """
        with raise_on_all_ranks(self.comm):
            if self.comm.rank == 0:
                self.out.mkdir(parents=True, exist_ok=True)
                before = files_of(read_result(self.out))
                files = [table.write_csv(self.out / name) for name, table in tables.items()]
                files += [write_scene(self.out, scene), self.out / "result.json"]
                names = {*before, *(f.relative_to(self.out).as_posix() for f in files)}
                write_json(self.out / "result.json", {**result, "files": sorted(names)})

    def write(
        self, scene: Scene | None, result: dict[str, Any], page: Callable[[], Page], *, clock: bool = True
    ) -> None:
        """Print the page, and write result.json, scene.toml, pictures, tables and report.html. Collective.

        ``page`` draws and composes, on rank 0 only, so it must not communicate. Files of the run before in this folder
        that are not written again are removed. On rank 0 ``result`` takes the names of all files, and with ``clock``
        the times ``total`` and ``pictures`` and the seconds of CPU.

        Raises OSError on all ranks: the folder cannot be written.
        """
        with raise_on_all_ranks(self.comm):
            if self.comm.rank == 0:
                self._write(scene, result, page, clock)

    def _write(self, scene: Scene | None, result: dict[str, Any], page: Callable[[], Page], clock: bool) -> None:
        if not self.writes:
            self.show(page())
            return
        self.out.mkdir(parents=True, exist_ok=True)
        before, numbers = files_of(read_result(self.out)), self.out / "result.json"
        files = [write_json(numbers, result), *([] if scene is None else [write_scene(self.out, scene)])]
        drawing = time.perf_counter(), sum(os.times()[:4])
        content = page()
        self.show(content)
        now = time.perf_counter(), sum(os.times()[:4])
        files += [*(table.write_csv(self.out / name) for name, table in content.tables.items()), *content.files]
        line = content.command or command_line(self.command, self.path, self.overrides, self.comm.size, content.options)
        files.append(
            write_report(
                self.out / "report.html", replace(content, command=line), scene=scene, result=result, files=files,
                notes=self.notes,
            )
        )  # fmt: skip
        if clock:
            result.setdefault("time", {}).update(
                pictures=now[0] - drawing[0], total=time.perf_counter() - self.begin,
                pictures_cpu=now[1] - drawing[1], total_cpu=sum(os.times()[:4]),
            )  # fmt: skip
        result["files"] = [f.relative_to(self.out).as_posix() for f in files if f.is_relative_to(self.out)]
        write_json(numbers, result)
        remove_files(self.out, set(before) - set(result["files"]))
        list_files(self.console, files)

    def show(self, page: Page) -> None:
        """Print the parts of a page that are for a terminal, its errors, summary and warnings. Rank 0 prints."""
        show_sections(self.console, page.sections)
        for text in page.errors:
            self.console.print(text, style="bold", markup=False, highlight=False)
        for text in page.summary:
            self.console.print(text, markup=False, highlight=False)
        show_warnings(self.console, [text for text in page.warnings if text not in self.notes])


def progress_bar(console: Console, count: ProgressColumn, *, quiet: bool = False) -> Progress:
    """Bars with the time left, in a terminal only; ``count`` says how far a task is, a share or m of n."""
    columns = (TextColumn("{task.description}"), BarColumn(), count, TextColumn("left"), TimeRemainingColumn())
    return Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True)


def list_files(console: Console, files: Sequence[Path]) -> None:
    """Print what was written, one a line."""
    console.print("files:")
    for file in files:
        console.print(f"  {file}", soft_wrap=True, markup=False)


def show_warnings(console: Console, warnings: Sequence[str]) -> None:
    """Print warnings in yellow."""
    for text in warnings:
        console.print(Padding.indent(Text(f"warning: {text}", "yellow"), 0), highlight=False)
