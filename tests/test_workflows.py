"""Workflows, which run elsewhere only: their steps call what this checkout has."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer.main

from softgrasp.fem.scene.file import find_scene, load_scene
from softgrasp.study.cli import app

yaml = pytest.importorskip("yaml")
pytestmark = pytest.mark.serial
ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
ACTIONS = r"(actions/[\w-]+|conda-incubator/setup-miniconda)@v\d+"


def jobs(path: Path) -> dict[str, dict[str, Any]]:
    """The jobs of a workflow; YAML reads its key `on` as true."""
    read = yaml.safe_load(path.read_text())
    assert set(read) <= {"name", True, "permissions", "concurrency", "jobs"}
    assert set(read[True]) <= {"push", "pull_request", "schedule", "workflow_dispatch"}
    return dict(read["jobs"])


def test_there_are_workflows() -> None:
    assert [path.stem for path in WORKFLOWS] == ["install", "pages", "test"]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_jobs_end_and_use_known_keys_actions_and_files(path: Path) -> None:
    for name, job in jobs(path).items():
        assert set(job) <= {"runs-on", "timeout-minutes", "environment", "defaults", "steps"}, name
        assert job["runs-on"] == "ubuntu-24.04"  # glibc 2.39; the wheels need 2.34
        assert job["timeout-minutes"] <= 120
        for step in job["steps"]:
            assert len({"uses", "run"} & set(step)) == 1
            assert "uses" not in step or re.fullmatch(ACTIONS, step["uses"])
            given = step.get("with", {})
            for key in ("python-version-file", "environment-file"):
                assert key not in given or (ROOT / given[key]).is_file()
        assert job["steps"][0]["uses"] == "actions/checkout@v4"


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_commands_are_targets_of_make_and_commands_of_the_program(path: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    command = typer.main.get_command(app)
    for job in jobs(path).values():
        for line in (step["run"] for step in job["steps"] if "run" in step):
            words = shlex.split(line)
            if words[0] == "make":
                assert set(words[1:]) <= targets, line
            elif words[:2] == ["docker", "build"]:
                assert (ROOT / "Dockerfile").is_file()
            else:
                words = words[words.index("softgrasp") + 1 :]  # docker run --rm IMAGE
                part = command.commands[words[0]]  # type: ignore[attr-defined]
                context = part.make_context(line, words[1:], resilient_parsing=False)
                if "scene" in context.params:
                    load_scene(find_scene(context.params["scene"]), context.params.get("set_") or [])


def test_containers_and_conda_name_what_the_project_needs() -> None:
    """The image installs this checkout with its solver and starts the command; conda has a DOLFINx that is accepted."""
    image = (ROOT / "Dockerfile").read_text()
    extras = set(re.findall(r"pip install .*'\.\[(.*)\]'", image)[0].split(","))
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {"solver"} <= extras <= set(declared)
    assert 'ENTRYPOINT ["softgrasp"]' in image
    assert all((ROOT / script).is_file() for script in re.findall(r"python (tools/\S+)", image))
    assert (ROOT / ".python-version").read_text().strip().startswith("3.12")
    assert re.search(r"^FROM python:3\.12", image, re.MULTILINE)
    packages = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    assert "fenics-dolfinx=0.11" in packages
    assert {"pip": [".[view]"]} in packages
