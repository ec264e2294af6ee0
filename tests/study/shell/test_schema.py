"""The printed schema takes every shipped scene and refuses what the loader refuses."""

from __future__ import annotations

import json
import tomllib
from typing import Any

import jsonschema
import pytest
from typer.testing import CliRunner

from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene import materials
from softgrasp.fem.scene.control import BASES
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.reduction.bases.registry import METHODS
from softgrasp.study.cli import app

pytestmark = pytest.mark.serial


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    """Of the schema as the command prints it."""
    schema = json.loads(CliRunner().invoke(app, ["schema"]).stdout)
    assert schema["$schema"] == jsonschema.Draft202012Validator.META_SCHEMA["$id"]
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("name", shipped_scenes())
def test_every_shipped_scene_fits(validator: jsonschema.Draft202012Validator, name: str) -> None:
    data = tomllib.loads(shipped_scenes()[name].read_text())
    assert [error.message for error in validator.iter_errors(data)] == []


MATERIAL = ("tissue", "material")


@pytest.mark.parametrize(
    ("path", "value", "good"),
    [
        *((MATERIAL, name, True) for name in materials.LIBRARY),
        (MATERIAL, "marshmallow", False),
        (MATERIAL, {"young": 1e4, "poisson": 0.3, "rho": 1e3}, True),
        (MATERIAL, {"young": 1e4, "rho": 1e3}, False),
        (MATERIAL, {"young": 1e4, "poisson": 0.5, "rho": 1e3}, False),
        (MATERIAL, {"young": 1e4, "poisson": 0.3, "mu": 1.0, "rho": 1e3}, False),
        (MATERIAL, {"lambda": 1, "mu": 1.0, "rho": 1e3}, True),
        (MATERIAL, {"lambda": 1.0, "mu": -1.0, "rho": 1e3}, False),
        (("effects",), {"gravity": False}, True),
        (("effects",), {"gravity": True}, False),
        (("reduction",), {"methods": ["psd", "global_pod"]}, True),
        (("control", "method"), "radi", True),
        (("control", "method"), "newton", False),
        (("output",), {"memory": 4.0}, True),
        (("output",), {"memory": "most"}, False),
        (("time", "step"), 5, False),
    ],
)
def test_schema_and_loader_agree(
    validator: jsonschema.Draft202012Validator, tmp_path: Any, path: tuple[str, ...], value: Any, good: bool
) -> None:
    file = shipped_scenes()["paper_lqr"]
    data = tomllib.loads(file.read_text())
    node = data
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    assert validator.is_valid(data) == good
    text = json.dumps(value) if not isinstance(value, dict) else (
        "{" + ", ".join(f"{key} = {json.dumps(item)}" for key, item in value.items()) + "}"
    )  # fmt: skip
    if good:
        load_scene(file, [f"{'.'.join(path)}={text}"])
    else:
        with pytest.raises(SceneError):
            load_scene(file, [f"{'.'.join(path)}={text}"])


def test_unknown_bases_are_refused(validator: jsonschema.Draft202012Validator) -> None:
    data = tomllib.loads(shipped_scenes()["paper_forward"].read_text())
    assert not validator.is_valid(data | {"reduction": {"methods": ["global_pud"]}})
    assert validator.is_valid(data | {"reduction": {"methods": ["global_pud"], "plugins": ["mine.py"]}})


def test_names_of_bases_are_those_that_can_be_built() -> None:
    assert list(BASES) == list(METHODS)
