"""Text meshes that are read here, against meshio."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from softgrasp.fem.errors import MeshError
from softgrasp.fem.mesh.file import _numbered, load_body
from softgrasp.fem.mesh.text import _Reader, read_text
from tests.fem.mesh.test_lattice import cut_box

pytestmark = pytest.mark.serial

ABAQUS = """*Heading
** of a test
*Node
10, 0., 0.0, -1e-3
11,1,0,.5E0
 3, 0, 1, 0.1234567890123456789
7, -0.0, 0, 1
12, 1., 1., 1.
*Nset, nset=base
10, 11, 3,
** a comment ends a block, and what follows is passed over
1, 2, 3, 4
*Element, type=C3D4, elset=soft
5, 10, 11,
3, 7
*Element, type=S3
8, 10, 11, 3
9, 11, 3, 7
*Element, TYPE=C3D4
6, 12, 11, 3, 7
*Element, type=C3D4
9000006, 12, 11, 7, 3
*Elset, elset=far
6, 9000006, 77
*Elset, elset=all, generate
5, 9, 1
*Elset, elset=one
6
*Elset, elset=both
all, one
*Material, name=Gel
*Elastic
2e4, 0.3
"""
GMSH = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
2 7 "the base"
3 3 "body"
3 4 "rest"
$EndPhysicalNames
$Entities
1 0 1 2
5 0 0 0 0
1 0 0 0 1 1 0 1 7 2 1 -2
1 0 0 0 1 1 1 1 3 1 1
2 0 0 0 1 1 1 2 3 4 1 -1
$EndEntities
$Nodes
3 5 2 20
0 5 0 1
4
0 0 0
2 1 0 2
20
2
1 0 0.1
0 1 3.3333333333333335e-03
3 1 0 2
9
5
0 0 1
1 1 1.
$EndNodes
$Elements
3 3 1 3
2 1 2 1
1 4 20 2
3 1 4 1
2 4 20 2 9
3 2 4 1
3 5 2 20 9
$EndElements
"""


def alike(one: Any, other: Any) -> bool:
    """Whether values are equal, with types and order."""
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, dict):
        return list(one) == list(other) and all(alike(one[key], other[key]) for key in one)
    a, b = np.asarray(one), np.asarray(other)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def parts(mesh: meshio.Mesh) -> tuple[Any, ...]:
    """All of a mesh that softgrasp uses."""
    sets = {name: each for name, each in mesh.cell_sets.items() if not str(name).startswith("gmsh:")}
    return (
        mesh.points,
        [block.type for block in mesh.cells],
        [block.data for block in mesh.cells],
        mesh.cell_data,
        mesh.field_data,
        sets,
    )


def of_meshio(path: Path) -> meshio.Mesh | None:
    """What meshio reads, None where it fails."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            return meshio.read(path, "abaqus" if path.suffix == ".inp" else "gmsh")
        except (Exception, SystemExit):
            return None


def write(path: Path, rng: np.random.Generator) -> None:
    """Tetrahedra, triangles and lines with marks, as meshio writes them: a part of a mesh in an order of its own."""
    points, cells = cut_box([2, 3, 2])
    points = points @ rng.normal(size=(3, 3))
    cells = cells[rng.permutation(len(cells))[:20]]
    blocks = [("tetra", cells[:11]), ("triangle", cells[:9, 1:]), ("tetra", cells[11:])]
    if "22" in path.stem:
        blocks.insert(1, ("line", cells[:2, :2]))
    blocks = blocks[:1] if "41" in path.stem else blocks  # meshio writes no entities of several kinds
    mesh = meshio.Mesh(points, blocks)
    if "22" in path.stem:
        tags = [rng.integers(1, 4, size=len(data)) for _, data in blocks]
        mesh.cell_data = {"gmsh:physical": tags, "gmsh:geometrical": [t + 1 for t in tags]}
        mesh.field_data = {"a part": np.array([2, 3])}
    style: dict[str, Any] = {} if path.suffix == ".inp" else {"binary": False}
    style["float_fmt"] = rng.choice([".16e", ".16g", ".6f", ".3g"])
    meshio.write(path, mesh, "abaqus" if path.suffix == ".inp" else "gmsh22" if "22" in path.stem else "gmsh", **style)


@pytest.mark.parametrize("name", ["a22.msh", "a41.msh", "a.inp"])
@pytest.mark.parametrize("seed", range(4))
def test_written_meshes(tmp_path: Path, name: str, seed: int) -> None:
    """With line ends of both kinds, and without the last one."""
    write(path := tmp_path / name, np.random.default_rng(seed))
    text = path.read_bytes()
    for each in (text, text.replace(b"\n", b"\r\n"), text.rstrip()):
        path.write_bytes(each)
        here, there = read_text(path), of_meshio(path)
        assert here is not None
        assert there is not None
        assert alike(parts(here), parts(there))


@pytest.mark.parametrize(("name", "text"), [("a.inp", ABAQUS), ("a.msh", GMSH)])
def test_marks_of_both_programs(tmp_path: Path, name: str, text: str) -> None:
    """Numbers with gaps in any order, groups of entities, comments, sets of all kinds."""
    (path := tmp_path / name).write_text(text)
    here, there = read_text(path), of_meshio(path)
    assert here is not None
    assert there is not None
    assert alike(parts(here)[:5], parts(there)[:5])
    sets, of = parts(here)[5], parts(there)[5]
    assert sets.keys() == of.keys()
    assert len(of) == {"a.inp": 5, "a.msh": 3}[name]
    for key in of:
        assert alike(sets[key], of[key])


@pytest.mark.parametrize("name", ["b22.msh", "b.inp", "abaqus.inp", "gmsh.msh"])
def test_damaged_files_are_left_to_meshio_or_read_alike(tmp_path: Path, name: str) -> None:
    """Bytes changed, lines dropped, doubled, moved or cut, at random: what is read is what meshio reads."""
    rng, path = np.random.default_rng(7), tmp_path / name
    if name in ("abaqus.inp", "gmsh.msh"):
        path.write_text({"abaqus.inp": ABAQUS, "gmsh.msh": GMSH}[name])
    else:
        write(path, rng)
    whole, read, refused = path.read_bytes(), 0, 0
    for _ in range(300):
        text, kind = bytearray(whole), rng.integers(4)
        if kind == 0:
            text[rng.integers(len(text))] = rng.choice(list(b'0123456789 ,.-+eE*$\r\nx"'))
        lines = bytes(text).split(b"\n")
        place = rng.integers(len(lines))
        if kind == 1:
            del lines[place]
        elif kind == 2:
            lines.insert(rng.integers(len(lines)), lines[place])
        elif kind == 3:
            lines[place] = lines[place][: rng.integers(len(lines[place]) + 1)]
        path.write_bytes(b"\n".join(lines))
        here, there = read_text(path), of_meshio(path)
        assert here is None or (there is not None and alike(parts(here), parts(there))), b"\n".join(lines)
        read, refused = read + (here is not None), refused + (there is None)
    assert read > 20
    assert refused > 20


def test_numbers_are_rounded_as_in_python() -> None:
    """Of 1 to 21 digits and any power, with those half-way between two doubles."""
    rng = np.random.default_rng(3)
    words = [repr(float(x)) for x in rng.normal(size=300) * 10.0 ** rng.integers(-320, 300, size=300)]
    words += [f"{x:.{n}e}" for x, n in zip(rng.normal(size=3000), rng.integers(0, 21, size=3000), strict=True)]
    words += [f"{2**53 + k}" for k in range(20)] + [f"{2**53 + k}.5" for k in range(20)] + ["9007199254740993e3"]
    words += [f"{(2**53 + 1 + 2 * k) * 5**9}e-9" for k in range(50)]  # half-way, in 20 digits and more
    words += [f"{(2**53 + 2 * k + 1) * 2**9}" for k in range(500)]  # half-way, in 19 digits
    words += ["-0", "+.5", "5.", "1e400", "1E-400", "-1e-5", "123456789012345678901234567890"]
    text = " ".join(words).encode()
    found = _Reader(text + b"\n", 0, len(text)).take(len(words), whole=False)
    np.testing.assert_array_equal(found.view(np.int64), np.array([float(word) for word in words]).view(np.int64))


@pytest.mark.parametrize("kind", [np.int8, np.int32, np.int64, np.uint64])
def test_numbered_without_sorting(kind: Any) -> None:
    """Against sorting, at both ends of what a type holds."""
    ends, rng = np.iinfo(kind), np.random.default_rng(1)
    for numbers in (
        rng.integers(-100 if ends.min else 0, 100, size=500).astype(kind),
        (ends.max - rng.integers(0, 9, size=50).astype(kind)).astype(kind),
        (ends.min + rng.integers(0, 9, size=50).astype(kind)).astype(kind),
        np.array([ends.min, ends.max, ends.max], dtype=kind),
    ):
        values, places = _numbered(numbers)
        expected, inverse = np.unique(numbers, return_inverse=True)
        assert values == expected.tolist()
        np.testing.assert_array_equal(places, inverse)


def test_meshio_reads_without_a_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(path := tmp_path / "a22.msh", np.random.default_rng(0))
    assert read_text(path) is not None
    monkeypatch.setattr("softgrasp.fem.mesh.text.functions", lambda *_: None)
    assert read_text(path) is None


@pytest.mark.parametrize("name", ["a.inp", "a.msh"])
@pytest.mark.parametrize(
    "text",
    [
        *("", "*NODE", ABAQUS.replace("3, 7", "3, 8"), GMSH.replace("9\n5", "9\n"), GMSH + "x"),
        ABAQUS.replace("5, 9, 1", " 5, 9, 99999999999999999999"),
        ABAQUS.replace("5, 9, 1", "5, 9, 0"),
        ABAQUS.replace("elset=far", "elset,=far"),  # a set without a name
    ],
)
def test_wrong_files_end_in_the_sentence_of_meshio(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str
) -> None:
    (path := tmp_path / name).write_text(text)
    with pytest.raises(MeshError) as here:
        load_body(path, 1.0)
    monkeypatch.setattr("softgrasp.fem.mesh.file.read_text", lambda _: None)
    with pytest.raises(MeshError) as there:
        load_body(path, 1.0)
    assert str(here.value) == str(there.value)
