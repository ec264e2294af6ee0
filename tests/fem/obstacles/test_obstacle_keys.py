"""Keys of obstacles: what is refused with which sentence, and obstacles that move along paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.obstacles import make_obstacles
from softgrasp.fem.scene.file import load_scene, resolved_toml
from softgrasp.fem.scene.scene import Scene

pytestmark = pytest.mark.ranks(1)  # nothing here knows of ranks
TABLE = "kind='halfspace', normal=[0, 2], offset=-0.05"
REFUSED = [
    ("{normal=[0, 1], offset=0}", "obstacle.0.kind is missing; give shape, disc and polygon in 2D"),
    ("{kind='wall'}", "obstacle.0.kind is \"wall\"; it must be 'halfspace', 'disc'"),
    ("{kind='halfspace', normal=[0, 1]}", "obstacle.0.offset is missing; a halfspace needs normal and offset"),
    ("{kind='halfspace', normal=[0, 0], offset=1}", "obstacle.0.normal is [0.0, 0.0]; it must have a direction"),
    (f"{{{TABLE}, radius=1}}", "obstacle.0.radius does not go with kind = 'halfspace'; a halfspace needs"),
    (f"{{{TABLE}, raduis=1}}", "obstacle.0.raduis is not a key; did you mean obstacle.0.radius?"),
    ("{kind='disc', center=[0, 9, 1], radius=1}", "obstacle.0.center has a vector of 3 entries; it must have 2"),
    ("{kind='ball', center=[0, 9, 1], radius=1}", "obstacle.0.kind is 'ball', of 3D; in this 2D scene use 'disc'"),
    ("{kind='disc', center=[0, 9], radius=0}", "obstacle.0.radius is 0; it must be > 0"),
    ("{kind='disc', center=[0, nan], radius=1}", "obstacle.0.center.1 is nan; it must be a finite number"),
    ("{kind='box', lo=[0, 5], hi=[1, 5]}", "obstacle.0.hi is [1.0, 5.0]; it must exceed lo"),
    ("{kind='box', lo=[2, 5], hi=[1, 6]}", "obstacle.0.lo, hi is [[2.0, 5.0], [1.0, 6.0]]; its first corner"),
    ("{kind='polygon', points=[[0, 0], [1, 1], [2, 2]]}", "obstacle.0.points lie on one line; they must enclose"),
    (
        "{kind='polygon', points=[[0, 0], [4, 0], [0, 4], [1, 1]]}",
        "obstacle.0.points[3] = [1.0, 1.0] is no corner of the convex hull of all points",
    ),
    (f"{{{TABLE}, parts=0}}", "obstacle.0.parts is 0; it must be >= 1"),
    (f"{{{TABLE}, parts=2, friction=0.1}}", "obstacle.0.parts cannot go with friction, which acts on nodes alone"),
    (f"{{{TABLE}, path={{}}}}", "obstacle.0.path.velocity or csv must be given, and not both"),
    (f"{{{TABLE}, path={{velocity=[1, 0, 0]}}}}", "obstacle.0.path.velocity has a vector of 3 entries"),
    (f"{{{TABLE}}}, {{{TABLE}, name='halfspace1'}}", "obstacle.0 and obstacle.1 are both named halfspace1"),
    (f"{{{TABLE}}}", "obstacle is given but nothing in this scene uses it"),
]


@pytest.mark.parametrize(("entry", "words"), REFUSED)
def test_a_wrong_obstacle_is_refused_in_one_sentence(entry: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if "uses it" not in words:
        use(monkeypatch)
    with pytest.raises(SceneError) as error:
        load_scene("paper_forward", [f"obstacle=[{entry}]"])
    assert words in str(error.value)


def use(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a scene have obstacles that nothing uses."""
    from softgrasp.fem.scene import scene as module

    check = module.check_obstacles
    monkeypatch.setattr(module, "check_obstacles", lambda obstacles, used: check(obstacles, True))


@pytest.fixture
def moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """A table with a path from a file, and a disc at constant velocity."""
    use(monkeypatch)
    table = tmp_path / "table.csv"
    table.write_text("t,x,y\n0,0,0\n1,0,0.5\n3,0,1\n")
    return load_scene(
        "paper_forward",
        [
            f"obstacle=[{{{TABLE}, path={{csv='{table}'}}}},"
            "{kind='disc', name='post', center=[3, 0], radius=0.5, path={velocity=[-1, 0]}}]"
        ],
    )


def test_obstacles_follow_their_paths(moved: Scene) -> None:
    table, post = make_obstacles(moved, 2)
    assert (table.name, post.name, post.kind) == ("halfspace1", "post", "disc")
    x = np.array([[0.5, 0.75], [0.0, 0.0]])
    assert table.gap(x, 0.0) == pytest.approx([0.8, 0.05], rel=1e-15)  # the normal has length 2 in the scene
    assert table.gap(x, 1.0) == pytest.approx([0.3, -0.45], rel=1e-14)  # the table's row at 1 s: up by 0.5
    slow = (table.gap(x, 1e-4) - table.gap(x, 0.0)) / 1e-4
    assert abs(slow).max() < 1e-3  # at rest at the start: a quadratic beginning
    assert np.array_equal(table.gap(x, 5.0), table.gap(x, 3.0))  # at rest behind the end of its table
    assert np.abs(table.rate(5.0)).max() < 1e-15  # rounding of the spline
    assert post.gap(x, 2.0)[1] == 0.5  # at x = 1
    assert post.normal(x, 2.0)[1].tolist() == [-1.0, 0.0]
    assert post.support(np.array([-1.0, 0.0]), 2.0) == -0.5


def test_the_file_of_a_path_counts_in_the_hash_and_is_named_absolutely(moved: Scene, tmp_path: Path) -> None:
    written = tmp_path / "scene.toml"
    written.write_text(resolved_toml(moved))
    again = load_scene(written)
    assert again.obstacle == moved.obstacle
    assert tmp_path / "table.csv" in again.files
    before = scene_hash(again)
    assert before == scene_hash(moved)
    (tmp_path / "table.csv").write_text("t,x,y\n0,0,0\n3,0,1\n")
    assert scene_hash(again) != before
    (tmp_path / "table.csv").write_text("t,x,y\n1,0,0\n2,0,1\n")
    with pytest.raises(SceneError, match=r"obstacle.0.path.csv: the times in .*table.csv must begin at 0, not at 1 s"):
        make_obstacles(again, 2)
