"""Tutorials as pages with their outputs and figures: scripts with cells, run in a kernel when the pages are built.

What a run gave is kept in out/gallery, under the hash of script and package, so that only what changed runs again.
"""

from __future__ import annotations

import base64
import hashlib
import io
import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jupytext
import nbformat
from PIL import Image

ROOT = Path(__file__).parents[1]
SKIP = "SOFTGRASP_TUTORIALS"  # "none": pages without outputs, in no time
LIMIT = 600  # [s] for one cell, and for the start of its kernel on a machine with other work
QUIET = {"extra_arguments": ["--log-level=40"]}  # of the kernel: errors only
INLINE = "module://matplotlib_inline.backend_inline"
THUMBNAIL = (480, 300)  # [px]
DATA_IMAGE = re.compile(r"data:image/(\w+);base64,([\w+/=]+)")


@dataclass(frozen=True)
class Tutorial:
    """One page, and the files that it shows."""

    name: str  # "forward"
    title: str  # the question that it answers
    text: str  # the page in Markdown
    notebook: str  # the same with its outputs, JSON
    images: dict[str, bytes]  # files by their place beside the page, "forward/0.png"

    @property
    def thumbnail(self) -> bytes | None:
        """A small picture of the first figure; None without figures."""
        if not self.images:
            return None
        with Image.open(io.BytesIO(next(iter(self.images.values())))) as picture:
            picture.seek(2 * getattr(picture, "n_frames", 1) // 3)  # of a film: on the way
            small = picture.convert("RGB")
        small.thumbnail(THUMBNAIL)
        file = io.BytesIO()
        small.save(file, "PNG")
        return file.getvalue()


def tutorials(scripts: Sequence[Path]) -> list[Tutorial]:
    """Pages of scripts in cells, whose names begin with "demo_"; two run at a time.

    Raises RuntimeError: a script failed; the message names it and ends with the kernel's own words.
    """
    with ThreadPoolExecutor(2) as pool:
        books = list(pool.map(notebook, scripts))
    return [page(path.stem.removeprefix("demo_"), book) for path, book in zip(scripts, books, strict=True)]


def notebook(script: Path) -> Any:
    """The script as a notebook, with outputs unless `SKIP` says none."""
    book = jupytext.read(script)
    if os.environ.get(SKIP) == "none":
        return book
    kept = ROOT / "out" / "gallery" / f"{script.stem}-{_digest(script)}.ipynb"
    if kept.exists():
        return nbformat.read(kept, as_version=4)
    execute(book, script.name)
    kept.parent.mkdir(parents=True, exist_ok=True)
    for old in kept.parent.glob(f"{script.stem}-*.ipynb"):
        old.unlink()
    nbformat.write(book, kept)
    return book


def execute(book: Any, name: str) -> None:
    """Run all cells in a fresh kernel of this Python, in a folder of its own.

    Raises RuntimeError: a cell failed.
    """
    import nbclient  # not needed for pages without outputs

    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "MPLBACKEND": INLINE}
    with TemporaryDirectory() as folder:
        client = nbclient.NotebookClient(
            book, timeout=LIMIT, startup_timeout=LIMIT, resources={"metadata": {"path": folder}}, **QUIET
        )
        try:
            client.execute(env=environment)
        except nbclient.exceptions.CellExecutionError as error:
            raise RuntimeError(f"{name}: {str(error)[-2000:]}") from error


def _digest(script: Path) -> str:
    """Hash of the script, of what it may read, and of the package."""
    rooms = ("fem", "reduction", "lqr", "study", "softgrasp", "demos")
    files = sorted(f for room in rooms for f in (ROOT / room).rglob("*") if f.suffix in (".py", ".c", ".toml", ".msh"))
    parts = [script.read_bytes(), *(f.read_bytes() for f in files if not f.name.startswith("demo_"))]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def page(name: str, book: Any) -> Tutorial:
    """Text, code, outputs and figures of a notebook as Markdown."""
    head = book.cells[0].source
    note = f"*The same as a [notebook]({name}.ipynb); the script is `demos/demo_{name}.py`.*"
    parts, images = [head, note], dict[str, bytes]()
    for cell in book.cells[1:]:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        outputs = cell.get("outputs", [])
        text = "".join(o.text for o in outputs if o.output_type == "stream" and o.name == "stdout").strip("\n")
        if text.strip():
            parts.append(f"```text\n{text}\n```")
        for output in outputs:
            if output.output_type != "stream":
                parts.extend(_shown(output.get("data", {}), name, images))
    title = head.splitlines()[0].lstrip("# ")
    return Tutorial(name, title, "\n\n".join(parts) + "\n", nbformat.writes(book), images)


def _shown(data: Any, name: str, images: dict[str, bytes]) -> Iterator[str]:
    """What a cell shows as Markdown; pictures become files, and objects without a text of their own are left out."""

    def kept(kind: str, data: str) -> str:
        place = f"{name}/{len(images)}.{kind}"
        images[place] = base64.b64decode(data)
        return place

    if "image/png" in data:
        yield f"![Figure {len(images) + 1} of this tutorial]({kept('png', data['image/png'])})"
    elif "text/html" in data:
        found = DATA_IMAGE.search(data["text/html"])
        if found:
            yield f"![Film of this tutorial]({kept(found[1], found[2])})"
        else:
            yield f'<div class="output">{data["text/html"]}</div>'
    elif "text/plain" in data and not data["text/plain"].startswith(("<", "[<")):
        yield f"```text\n{data['text/plain']}\n```"


def index(pages: Sequence[Tutorial]) -> str:
    """The gallery: a picture and a question each."""
    cards = []
    for each in pages:
        picture = f"![]({each.name}/thumbnail.png)<br>" if each.images else ""
        cards.append(f"- [{picture}{each.title}]({each.name}.md)")
    return "\n".join(
        [
            "# Tutorials",
            "",
            "One question each, answered by a script that was run when these pages were built: every number and figure",
            "below its code is what that code gave. `demos/` has the scripts, and each page its notebook.",
            "",
            '<div class="gallery" markdown>',
            "",
            *cards,
            "",
            "</div>",
            "",
        ]
    )
