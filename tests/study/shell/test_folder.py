"""Runs do not overwrite each other: what a folder holds decides whether a command may write into it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softgrasp.fem.errors import SceneError
from softgrasp.study.shell.folder import claim, default_folder

pytestmark = pytest.mark.serial


def leave(folder: Path, command: str = "simulate", scene: str = "strip") -> None:
    (folder / "models").mkdir(parents=True)
    (folder / "models" / "psd.h5").write_text("x")
    (folder / "result.json").write_text(json.dumps({"command": command, "scene": scene}))


def test_every_scene_and_command_has_its_folder() -> None:
    assert default_folder("reduce", Path("a/strip.toml")) == Path("out/strip-reduce")


def test_a_folder_of_another_run_is_refused_or_emptied(tmp_path: Path) -> None:
    out = tmp_path / "run"
    claim(out, "simulate", "strip", empty=True)  # not there yet
    leave(out)
    claim(out, "simulate", "strip")
    assert (out / "models" / "psd.h5").exists()  # the same run again writes over its own files
    for command, scene in (("reduce", "strip"), ("simulate", "block")):
        with pytest.raises(SceneError, match=r"results of simulate on strip; .* --empty"):
            claim(out, command, scene)
    claim(out, "reduce", "block", empty=True)
    assert list(out.iterdir()) == []


def test_only_what_a_run_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(SceneError, match=r"no result\.json"):
        claim(tmp_path, "simulate", "strip", empty=True)
    leave(tmp_path / "a")
    (tmp_path / "result.json").write_text('{"command": "simulate", "scene": "strip"}')
    with pytest.raises(SceneError, match="would also remove"):
        claim(tmp_path, "simulate", "strip", empty=True)
    scene = tmp_path / "a" / "strip.toml"
    scene.write_text("")
    with pytest.raises(SceneError, match=r"would also remove .*strip\.toml"):
        claim(tmp_path / "a", "simulate", "strip", path=scene, empty=True)
    assert (tmp_path / "a" / "models" / "psd.h5").exists()
    assert (tmp_path / "thesis.tex").exists()
