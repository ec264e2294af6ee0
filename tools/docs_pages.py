"""Pages of the documentation that are made from the source: scene keys, tutorials and notebooks, references, changes.

A hook of MkDocs; `make docs` runs it.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import gallery  # beside this file
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import softgrasp
from softgrasp.fem.scene.scene import scene_schema
from softgrasp.fem.shown import unbroken

ROOT = Path(__file__).parents[1]
DEMOS = sorted((ROOT / "demos").glob("demo_*.py"))
ORDER = (
    "forward",
    "finite_strain",
    "foreign_mesh",
    "reduce",
    "own_basis",
    "certified",
    "control",
    "effects",
    "turn",
    "contact",
    "arm",
    "ranks",
)  # of the gallery
OWN_BASIS = "static_responses.py"
SHORT = 12  # letters of a cell that stays in one line
ROOMS = {"fem": "Scene, model, run", "reduction": "Reduced models", "lqr": "Control", "study": "Many runs"}
MORE = {
    "study": ["study.runs.sweep.SweepTable", "study.notebook.Film"],
    "fem": ["fem.run.states.trajectory.Trajectory", "fem.run.simulate.RunOptions", "fem.fields.series.SeriesWriter"],
    "reduction": [
        "reduction.bases.registry.METHODS",
        "reduction.online.ReducedTrajectory",
        "reduction.model.ReducedModel",
        "reduction.system.EnergySystem",
        "fem.reduced.ReducedSystem",
    ],
    "lqr": ["lqr.loop.full.LoopTrajectory", "lqr.loop.margins.loop_margins", "lqr.loop.margins.LoopMargins"],
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made."""
    pages = {"scene.md": scene_keys(scene_schema()), "references.md": (ROOT / "REFERENCES.md").read_text()}
    pages["api.md"] = python_names()
    pages["changes.md"] = (ROOT / "CHANGELOG.md").read_text()
    pages[OWN_BASIS] = (ROOT / "demos" / OWN_BASIS).read_text()
    shown = {each.name: each for each in gallery.tutorials(DEMOS)}
    pages["tutorials/index.md"] = gallery.index([shown[name] for name in ORDER])
    images = dict[str, bytes]()
    for name, each in shown.items():
        pages[f"tutorials/{name}.md"], pages[f"tutorials/{name}.ipynb"] = each.text, each.notebook
        images |= each.images
        if each.thumbnail is not None:
            images[f"{name}/thumbnail.png"] = each.thumbnail
    for place, content in (pages | {f"tutorials/{place}": data for place, data in images.items()}).items():
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links to files of the checkout, which live in the raw pages, become links to the pages made of them."""
    made = {
        "REFERENCES.md": "references.md",
        "CHANGELOG.md": "changes.md",
        "demos/scenes/scene.schema.json": "scene.md",
        f"demos/{OWN_BASIS}": OWN_BASIS,
    }
    made |= {f"demos/{path.name}": f"tutorials/{path.stem.removeprefix('demo_')}.md" for path in DEMOS}
    folder = (ROOT / "docs" / page.file.src_uri).parent

    def link(found: re.Match[str]) -> str:
        target = os.path.relpath(folder / found[1], ROOT)
        return f"]({os.path.relpath(ROOT / 'docs' / made[target], folder)}" if target in made else found[0]

    return re.sub(r"\]\(([^)#:]+)", link, markdown)


def on_page_content(html: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """No line ends inside 5.5e-13 or --set in a table, or between a number and its unit."""

    def cell(found: re.Match[str]) -> str:
        start, inside, end = found.groups()
        short = len(re.sub(r"<[^>]*>", "", inside)) <= SHORT
        whole = r'<span class="whole">\g<0></span>'
        return start + re.sub(r"(?s)^.+$" if short else r"(?<=[ >])--?[a-z][\w-]*", whole, inside) + end

    html = re.sub(r"(?s)(<td[^>]*>)(.*?)(</td>)", cell, html)
    parts = re.split(r"(?s)(<(?:pre|code|script|style)\b.*?</(?:pre|code|script|style)>|<[^>]*>)", html)
    return "".join(part if i % 2 else unbroken(part) for i, part in enumerate(parts))


def on_post_build(config: MkDocsConfig) -> None:
    """Without its own 404.html, whose links are absolute and so right for a site at the root of a server only."""
    (Path(config.site_dir) / "404.html").unlink(missing_ok=True)


def python_names() -> str:
    """What `import softgrasp` gives, in the order of the rooms, and some classes that it returns."""
    text = [
        "# Python",
        "What `import softgrasp as sg` gives; a name is loaded when it is used. A function is collective only if it "
        "says so.",
    ]
    for room, title in ROOMS.items():
        names = [f"{module}.{name}" for name, module in softgrasp._FACE.items() if module.split(".")[0] == room]
        text += [f"## {title}", *(f"::: softgrasp.{name}" for name in [*names, *MORE[room]])]
    return "\n\n".join(text) + "\n"


def scene_keys(schema: dict[str, Any]) -> str:
    """All keys of a scene, a table a section, from the JSON schema."""
    text = [
        "# Scene keys",
        "A scene is a TOML file. Every key has a unit; what is not given has its default. `softgrasp schema` "
        "prints the same as a JSON schema, which editors use to complete and check keys.",
    ]
    seen: list[str] = []

    def section(path: str, table: dict[str, Any]) -> None:
        rows, below = [], []
        for key, entry in table["properties"].items():
            where = f"{path}.{key}" if path else key
            names = re.findall(r'"\$ref": "#/\$defs/(\w+)"', json.dumps(entry))
            parts = [(n, schema["$defs"][n]) for n in names if "properties" in schema["$defs"][n]]
            below += [(where, n, part) for n, part in parts if n not in seen]
            seen.extend(n for n, _ in parts if n not in seen)
            default = _shown(entry["default"]) if "default" in entry else ""
            default = "required" if key in table.get("required", []) else default
            rows.append(f"| `{key}` | {_kind(entry, schema)} | {default} | {_safe(entry.get('description', ''))} |")
        text.append(f"## `{path or 'top of the file'}`" if path else "## Top of the file")
        if path and table.get("description"):
            text.append(_safe(table["description"].split("\n\n")[0].replace("\n", " ")))
        text.append("\n".join(["| key | value | default | meaning |", "| --- | --- | --- | --- |", *rows]))
        for where, _, part in below:
            section(where, part)

    section("", schema)
    return "\n\n".join(text) + "\n"


def _safe(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if value in ({}, []) or isinstance(value, dict):
        return ""
    return f"`{json.dumps(value)}`"


def _kind(entry: dict[str, Any], schema: dict[str, Any]) -> str:
    """Type of a key in words."""
    if "$ref" in entry:
        target = schema["$defs"][entry["$ref"].rsplit("/", 1)[-1]]
        return "table" if "properties" in target else _kind(target, schema)
    if "enum" in entry:
        return " or ".join(f"`{_shown(v).strip('`')}`" for v in entry["enum"])
    if "const" in entry:
        return _shown(entry["const"])
    for word in ("anyOf", "oneOf", "allOf"):
        if word in entry:
            kinds = [_kind(e, schema) for e in entry[word] if e.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds))
    kind = entry.get("type", "")
    if kind == "array":
        items = entry.get("items") or (entry.get("prefixItems") or [{}])[0]
        inner = _kind(items, schema) if isinstance(items, dict) else ""
        return f"list of {inner}" if inner else "list"
    if kind == "object":
        return "table"
    return {"integer": "whole number", "number": "number", "string": "text", "boolean": "true or false"}.get(kind, kind)
