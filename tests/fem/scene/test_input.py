"""What text and numbers may enter: bad ones end in one sentence of bounded length, wherever they come from."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from softgrasp.fem.errors import LONGEST, SceneError, SoftgraspError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.scene.file import load_scene, resolved_toml, shipped_scenes
from softgrasp.fem.scene.table import read_csv

pytestmark = pytest.mark.serial  # nothing here knows of ranks
PAPER = shipped_scenes()["paper_forward"]
TEXT = PAPER.read_text(encoding="utf-8")
KEYS = (
    "name", "description", "tissue.size", "tissue.origin", "tissue.cells", "tissue.mesh", "tissue.order",
    "tissue.material", "tissue.material.mu", "tissue.layers.fat", "tissue.layers.fat.tag", "contact.sides",
    "contact.box", "contact.facet_tag", "hand.mass", "hand.reference", "effects.gravity", "effects.reaction",
    "motion.csv", "motion.target", "time.steps", "time.end", "control.outputs", "control.outputs.0.name", "control.Q",
    "reduction.N", "reduction.train", "study.tolerance", "output.every", "nowhere", "nowhere.at.all",
)  # fmt: skip
VALUES = (
    "9" * 30, "9" * 400, "-" + "9" * 5000, "0x" + "f" * 5000, str(2**63), "[" * 100 + "]" * 100,
    "[" * 3000 + "]" * 3000, "{a=" * 500 + "1" + "}" * 500, "1e300", "[1e300, 0.0]", "-1e-300", "'a$b\\\\'",
    '"a\\u0000b"', '"\\u001b[2J"', "'" + "x" * 5000 + "'", "x" * 5000, "'\ud800'", "[[1e308, 1e308], [1e308, 1e308]]",
    "{ 'a$' = 1 }", "{ " + "k" * 200 + " = 1 }", "2020-01-01", "[" + "'q'," * 3000 + "]", "", "\n" * 900,
)  # fmt: skip
MEANT = {("description", 11): "text that no figure draws"}


def sentence(call: Callable[[], object]) -> str:
    """The error of a call: one line of bounded length, on every rank, also after its way between ranks."""
    with pytest.raises(SoftgraspError) as caught:
        call()
    text = str(caught.value)
    assert 20 < len(text) <= LONGEST
    assert text.isprintable()
    assert text.encode()
    assert str(pickle.loads(pickle.dumps(caught.value))) == text
    return text


@pytest.mark.parametrize("key", KEYS)
def test_no_value_of_a_key_ends_in_a_traceback(key: str) -> None:
    for i, value in enumerate(VALUES):
        if (key, i) not in MEANT:
            sentence(lambda value=value: load_scene(PAPER, [f"{key}={value}"]))


@pytest.mark.parametrize(
    "change",
    [
        "=",
        "a" * 5000,
        ".".join("a" * 3000) + "=1",
        "control.outputs." + "9" * 5000 + ".b=1",
        "a\ud800=1",
        "control.outputs.\N{SUPERSCRIPT TWO}.name=1",
        "hand." + "m" * 5000 + "=1",
    ],
)
def test_no_key_ends_in_a_traceback(change: str) -> None:
    sentence(lambda: load_scene(PAPER, [change]))


@pytest.mark.parametrize(
    "key", [*KEYS, "hand." + "m" * 5000, "time.steps." + "m" * 5000, "control.outputs." + "8" * 5000]
)
def test_no_sentence_repeats_what_is_long(key: str) -> None:
    """Of a value 60 letters, of a name of a key 80: more hides what is wrong."""
    for value in ("9" * 5000, "x" * 5000, "[" + "1," * 5000 + "]", "'" + "x" * 5000 + "'"):
        try:
            load_scene(PAPER, [f"{key}={value}"])
        except SceneError as error:
            text = str(error)
        else:
            assert key in ("description", "reduction.N")  # which take a long text and a long list
            continue
        assert not re.search(r"9{61}|x{61}|8{61}|m{81}|(1, ?){31}", text)


@pytest.mark.parametrize("key", [
    "tissue.refine.grading", "contact.facet_tag", "hand.inertia", "control.Q", "control.R", "control.loop.limit",
    "control.loop.delay", "reduction.train", "reduction.motions", "output.memory", "output.frames",
])  # fmt: skip
def test_a_table_where_one_of_several_types_belongs_is_named_by_its_key(key: str) -> None:
    text = sentence(lambda: load_scene(PAPER, [f"{key}={{a = {{b = 1}}}}"]))
    assert f"{key} is {{ a = {{ b = 1 }} }}; it must be " in text


def test_a_name_that_no_file_can_have_is_refused() -> None:
    assert "cannot be read" in sentence(lambda: load_scene("q" * 5000))


FILES: dict[str, tuple[bytes, str]] = {
    "latin": (TEXT.encode().replace(b'name = "', b'name = "\xe9', 1), r"is not UTF-8 text (line 2)"),
    "utf16": (TEXT.encode("utf-16"), "is not UTF-8 text"),
    "nul": (TEXT.encode() + b"\0", "not valid TOML"),
    "brackets": (TEXT.encode() + b"\nx=" + b"[" * 3000 + b"]" * 3000, "too many nested brackets"),
    "tables": (TEXT.encode() + b"\nx=" + b"{a=" * 3000 + b"1" + b"}" * 3000, "too many nested brackets"),
    "digits": (TEXT.replace("steps = 600", "steps = " + "6" * 5000).encode(), "integer of thousands of digits"),
    "deep": (TEXT.encode() + b"\n[" + b".".join([b"a"] * 3000) + b"]\nx=1", "nests more than 16"),
    "twice": (2 * (TEXT.encode() + b"\n"), "not valid TOML"),
    "empty": (b"", "name is missing"),
    "long": (b"x" * 100_000, "not valid TOML"),
    "bytes": (bytes(range(256)), "is not UTF-8 text"),
}


@pytest.mark.parametrize("case", FILES)
def test_no_scene_file_ends_in_a_traceback(case: str, tmp_path: Path) -> None:
    data, words = FILES[case]
    path = tmp_path / "scene.toml"
    path.write_bytes(data)
    assert words in sentence(lambda: load_scene(path))


def test_a_file_without_end_is_refused() -> None:
    if not Path("/dev/zero").exists():
        pytest.skip("no endless file here")
    assert "larger than" in sentence(lambda: load_scene("/dev/zero"))


def test_a_byte_order_mark_is_no_error(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(b"\xef\xbb\xbf" + TEXT.encode())
    assert scene_hash(load_scene(path)) == scene_hash(load_scene(PAPER))
    table = tmp_path / "hand.csv"
    table.write_bytes("\N{BYTE ORDER MARK}0,0\n1,2\n".encode())
    assert np.array_equal(read_csv(table, 1, 1.0)[1], [[0.0], [2.0]])


def test_every_letter_of_a_text_survives(tmp_path: Path) -> None:
    text = "é → λ \N{NO-BREAK SPACE}\U0001f916 'q' \"d\" {[#]}"
    scene = load_scene(PAPER, ["name='é λ'", f"description='''{text}'''", "tissue.material.rho=1e-50"])
    path = tmp_path / "scene.toml"
    path.write_text(resolved_toml(scene), encoding="utf-8")
    again = load_scene(path)
    assert (again.name, again.description, again.tissue.material.rho) == ("é λ", text, 1e-50)


TABLES: dict[str, tuple[bytes, str]] = {
    "latin": (b"t;\xe9\n0,0\n1,1\n", "is not UTF-8 text (line 1)"),
    "nul": (b"0,0\n1,\x001\n", "not a number in data row 2"),
    "ragged": (b"0,0\n1\n", "has 1 entries in data row 2; it must have 2 columns"),
    "wide": (b"0,0,0\n1,1,1\n", "has 3 entries in data row 1"),
    "large": (b"0,0\n1,1e300\n", "has 1e+300 as column 2, at t = 1 s, in data row 2"),
    "infinite": (b"0,0\n1e999,1\n", "has inf as the time in data row 2"),
    "words": (b"0,0\n1,abc\n", "not a number in data row 2"),
    "first": (b"0,abc\n1,1\n", "not a number in data row 1"),
    "field": (b'0,0\n1,"' + b"x" * 200_000 + b'"\n', "is no CSV table"),
    "header": (b"t,x\n", "has 0 rows"),
    "empty": (b"", "has 0 rows"),
}


@pytest.mark.parametrize("case", TABLES)
def test_no_table_of_motion_ends_in_a_traceback(case: str, tmp_path: Path) -> None:
    data, words = TABLES[case]
    path = tmp_path / "hand.csv"
    path.write_bytes(data)
    assert words in sentence(lambda: read_csv(path, 1, 1.0))


def test_a_long_sentence_keeps_its_ends() -> None:
    text = str(SceneError("begin " + "x\n" * 5000 + " end"))
    assert len(text) <= LONGEST
    assert text.startswith("begin x")
    assert text.endswith("end")
    assert " ... " in text
    assert str(SceneError("as it was")) == "as it was"


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("stiffness=1", "stiffness is not a key; did you mean tissue.material.young?"),
        ("tissue.layers.fat.E=1", "tissue.layers.fat.E is not a key; did you mean tissue.layers.fat.material.young?"),
        # not mu, which is one letter away
        ("tissue.material={nu=1.0}", "tissue.material.nu is not a key; did you mean tissue.material.poisson?"),
        (
            "tissue.layers.fat.material={density=1.0}",
            "fat.material.density is not a key; did you mean tissue.layers.fat.material.rho?",
        ),
        ("control.dt=1", "control.dt is not a key; did you mean time.steps?"),
        # half of its letters are those of mesh
        ("tissue.elements=1", "tissue.elements is not a key; keys of tissue are size, origin, "),
    ],
)
def test_hint_for_a_key_that_others_use(override: str, text: str) -> None:
    assert text in sentence(lambda: load_scene(shipped_scenes()["layers_2d"], [override]))


def test_a_folder_of_its_name_does_not_hide_a_shipped_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "set_down").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_scene("set_down").name == "set_down"
