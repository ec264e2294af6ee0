"""``softgrasp identify``: fit the material of a scene to measurements; page, table and the scene with the values."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from rich.console import Console
from rich.progress import TextColumn

from softgrasp.fem.owned import note
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.reduction.identify.identify import Law, identify
from softgrasp.reduction.identify.result import Identified
from softgrasp.study.identify.page import compose, result_of
from softgrasp.study.report.origin import origin
from softgrasp.study.shell import Session, folder_lock

REFUSED = 3  # exit status


@folder_lock()
def run_identify(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    data: Sequence[Path],
    fit: str,
    noise: str,
    columns: int,
    offset: bool = False,
    shift: bool = False,
    robust: bool = False,
    refine: bool = False,
    law: str = "auto",
    certified: Path | None = None,
    posterior: int = 0,
    quiet: bool = False,
    pictures: bool = True,
    empty: bool = False,
) -> int:
    """Fit a scene file and write page, tables and fitted.toml, see ``softgrasp identify --help``. Collective.

    Returns:
        Exit status: 0, or 3 when the answer is refused.

    Raises SoftgraspError: with one sentence.
    """
    session = Session("identify", path, overrides, out, console, quiet, pictures, empty=empty)
    scene = session.scene(data if certified is None else [*data, certified])
    model = session.model(scene)
    with session.progress(TextColumn("")) as bar:
        task = bar.add_task("rounds of the fit", total=None)
        answer = identify(
            model, list(data), fit, noise, N=columns, offset=offset, shift=shift, robust=robust, refine=refine,
            law=cast(Law, law), certified=certified, posterior=posterior,
            progress=lambda done: bar.update(task, description=f"round {done} of the fit"),
        )  # fmt: skip
    result = {"command": "identify", **origin(scene, session.comm.size), **result_of(answer), "time": {}}
    given = {"fit": fit, "noise": noise, "columns": columns, "law": law}
    given |= {} if certified is None else {"certified": certified}
    given |= {"posterior": posterior} if posterior else {}
    flags = {"offset": offset, "shift": shift, "robust": robust, "refine": refine}
    words = "".join(f" {shlex.quote(str(file))}" for file in data)
    words += "".join(f" --{key} {shlex.quote(str(value))}" for key, value in given.items())
    words += "".join(f" --{key}" for key, value in flags.items() if value)
    fitted = session.out / "fitted.toml"
    session.write(scene, result, lambda: compose(answer, session, write_fitted(answer, fitted), words))
    return REFUSED if answer.reasons else 0


def write_fitted(answer: Identified, path: Path) -> Path:
    """The scene with the values, the error of each and why it is refused in comments. Not collective."""
    lines = [f"# {name} = {text}" for name, text in answer.rows()]
    lines += [f"# misfit {answer.residuals.misfit:.3g} sigma, by chance at most {answer.residuals.limit:.3g}"]
    lines += [f"# REFUSED: {reason}" for reason in answer.reasons]
    note(path)
    path.write_text("\n".join([*lines, resolved_toml(answer.scene)]))
    return path
