"""``softgrasp identify --suggest-markers K``: the markers and the motion that determine the material best."""

from __future__ import annotations

import itertools
import shlex
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from softgrasp.fem import SceneError, gather_picture
from softgrasp.fem.errors import shortened
from softgrasp.reduction.identify.suggest import suggest_markers
from softgrasp.study.identify.suggest.page import compose, result_of
from softgrasp.study.report.origin import origin
from softgrasp.study.shell import Session, folder_lock

MOST_MOTIONS = 50
REFUSED = 3  # exit status


@folder_lock()
def run_suggest(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    fit: str,
    noise: str,
    markers: int,
    motions: Sequence[str] = (),
    rate: float | None = None,
    offset: bool = False,
    shift: bool = False,
    columns: int,
    quiet: bool = False,
    pictures: bool = True,
    empty: bool = False,
) -> int:
    """Choose markers for a scene and write page and tables, see ``softgrasp identify --help``. Collective.

    Returns:
        Exit status: 0, or 3 when a combination of the parameters is not seen.

    Raises SoftgraspError: with one sentence.
    """
    family, sigma = parse_motions(motions), parse_sigma(noise)
    session = Session("identify", path, overrides, out, console, quiet, pictures, empty=empty)
    scene = session.scene()
    model = session.model(scene)
    answer = suggest_markers(
        model, fit, sigma, markers, motions=family, rate=rate, offset=offset, shift=shift, N=columns
    )
    picture = gather_picture(model)
    result = {"command": "identify", **origin(scene, session.comm.size), **result_of(answer), "time": {}}
    given = {"fit": fit, "noise": noise, "suggest-markers": markers, "rate": rate, "columns": columns}
    words = "".join(f" --{key} {shlex.quote(str(value))}" for key, value in given.items() if value is not None)
    words += "".join(f" --motions {shlex.quote(text)}" for text in motions)
    words += "".join(f" --{key}" for key, value in {"offset": offset, "shift": shift}.items() if value)
    session.write(scene, result, lambda: compose(answer, picture, session, words))
    return REFUSED if answer.motions[0].hidden else 0


def parse_sigma(text: str) -> float:
    """The standard deviation of each coordinate. Raises SceneError: it is no number > 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise SceneError(f"--noise {shortened(text)}: markers to choose need one standard deviation > 0, such as 1e-3")
    return value


def parse_motions(texts: Sequence[str]) -> list[dict[str, Any]]:
    """All motions of ``duration=0.5;1`` and ``target=[1,0];[0,1]``: every value with every other.

    Raises SceneError: a text is no key with values, a key is given twice, or the motions are too many.
    """
    axes: dict[str, list[Any]] = {}
    for text in texts:
        key, equals, values = text.partition("=")
        try:
            parsed = [tomllib.loads(f"x = {value}")["x"] for value in values.split(";")]
        except tomllib.TOMLDecodeError:
            parsed = []
        if not (equals and key.strip() and parsed) or key.strip() in axes:
            raise SceneError(
                f"--motions {shortened(text)}: give a key of [motion] once with its values, as in duration=0.5;1;2 or "
                "target=[1,0];[0,1]"
            )
        axes[key.strip()] = parsed
    found = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())] if axes else []
    if len(found) > MOST_MOTIONS:
        raise SceneError(f"--motions: {len(found)} motions are too many; give at most {MOST_MOTIONS}")
    return found
