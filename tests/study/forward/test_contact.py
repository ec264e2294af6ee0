"""What `simulate` reports of contact, and the commands that refuse it."""

from __future__ import annotations

import importlib.util
import io
from pathlib import Path

import matplotlib.pyplot as plt
import meshio
import numpy as np
import pytest
from matplotlib.quiver import Quiver
from PIL import Image
from rich.console import Console
from scipy.spatial import Delaunay

from softgrasp.fem.errors import SceneError
from softgrasp.fem.fields.picture import gather_picture
from softgrasp.fem.model.build import build
from softgrasp.fem.run.contact.general import contact_surface
from softgrasp.fem.run.simulate import simulate
from softgrasp.reduction.reduce import reduce
from softgrasp.study.forward.cautions import small_obstacles
from softgrasp.study.forward.explain import explain_model
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.pictures.body import draw_surroundings, legend, make_axes, make_view
from softgrasp.study.pictures.shapes import seen
from softgrasp.study.pictures.view import Move

pytestmark = pytest.mark.serial
SCENE = ["tissue.cells=[4, 8]", "motion={profile='hold'}", "effects.gravity={g=[0, -5]}", "time.steps=100",
         "time.end=1",
         "effects.obstacles=true",
         "obstacle=[{kind='halfspace', name='table', normal=[0, 1], offset=-0.03}]"]  # fmt: skip


def test_forces_gaps_and_touching_nodes_are_in_the_files(tmp_path: Path) -> None:
    result = run_simulate(Path("paper_forward"), tmp_path, SCENE, Console(quiet=True), pictures=False)
    contact = simulate(build("paper_forward", SCENE)).contact
    assert contact is not None
    keys = result["contact"]["obstacles"]["table"]
    assert keys["force_end"] == ((contact.force[-2, 0] + contact.force[-1, 0]) / 2).tolist()
    assert result["contact"]["force_end"] == pytest.approx(contact.force_end.sum(axis=0), rel=1e-12)  # order of the sum
    assert keys["nodes_max"] == contact.touching.max() > 0
    assert result["contact"]["chatter"] == contact.chatter
    assert result["contact"]["chatter_end"] == contact.chatter_end
    header, *rows = (tmp_path / "trajectory.csv").read_text().splitlines()
    names = header.split(",")
    table = np.array([[float(x) for x in row.split(",")] for row in rows])
    assert np.allclose(table[1:, names.index("table_force_y [N]")], contact.force[:, 0, 1], rtol=1e-9)  # digits written
    assert np.allclose(table[:, names.index("table_gap [m]")], contact.gap[:, 0], rtol=1e-9, atol=1e-15)


def test_reduction_refuses_contact() -> None:
    model = build("paper_forward", SCENE)
    with pytest.raises(SceneError, match=r"sg.contact_model, cannot go with effects.obstacles yet"):
        reduce(model, simulate(model))


@pytest.mark.parametrize(
    ("obstacle", "order", "size"),
    [  # of a body of 1 m by 2 m: boundary edges of 0.25 m
        ("kind='disc', center=[0.5, -0.5], radius=0.24", 1, "0.24 m in radius"),
        ("kind='disc', center=[0.5, -0.5], radius=0.26", 1, ""),
        ("kind='disc', center=[0.5, -0.5], radius=0.24", 2, ""),
        ("kind='disc', center=[0.5, -0.5], radius=0.12", 2, "0.12 m in radius"),
        ("kind='box', lo=[-2, -0.5], hi=[2, -0.3]", 1, "0.2 m thick"),
        ("kind='box', lo=[-2, -0.5], hi=[2, -0.25]", 1, ""),  # as thick as an edge is long
        ("kind='polygon', points=[[0, -0.1], [-1, -1], [1, -1]]", 1, ""),
        ("kind='halfspace', normal=[0, 1], offset=-0.1", 1, ""),
    ],
)
def test_an_obstacle_that_is_small_against_an_edge_is_warned_of(obstacle: str, order: int, size: str) -> None:
    scene = [*SCENE[:-1], f"tissue.order={order}"]
    assert not small_obstacles(build("paper_forward", [*scene, f"obstacle=[{{name='pin', {obstacle}}}]"]))
    model = build("paper_forward", [*scene, f"obstacle=[{{name='pin', {obstacle}, parts=1}}]"])
    expected = f"Obstacle 'pin' is {size}, less than the {0.25 / order:.2g} m between boundary nodes"
    texts = small_obstacles(model)
    assert [text.partition(":")[0] for text in texts] == ([expected] if size else [])
    if "0.24" in size:  # one is enough
        assert texts[0] in explain_model(model).warnings


@pytest.mark.parametrize(
    ("friction", "radius", "parts"),
    [(0.3, 0.1, 5), (0.3, 0.26, 0), (0.0, 0.1, 0)],  # on edges of 0.25 m: 0.25 / (0.1 / 2) = 5; nodes do; no friction
)
def test_friction_of_one_obstacle_that_lets_nodes_alone_touch_is_said(
    friction: float, radius: float, parts: int
) -> None:
    rough = f"{{name='rough', kind='halfspace', normal=[0, 1], offset=-0.5, friction={friction}}}"
    pin = f"{{name='pin', kind='disc', center=[0.5, -0.6], radius={radius}}}"
    model = build("paper_forward", [*SCENE[:-1], f"obstacle=[{rough}, {pin}]"])
    texts = [text for text in explain_model(model).warnings if "nodes alone" in text]
    assert [f"points that divide each edge in {parts} " in text for text in texts] == [True] * bool(parts)
    assert all(text.startswith("Obstacle 'rough' has friction") for text in texts)
    assert (contact_surface(model).B is None) == (friction > 0 or radius > 0.25)  # what the sentence is about


@pytest.mark.parametrize("offset", [-5.0, -0.34, -0.25])
def test_explain_advises_to_drop_obstacles_that_the_path_stays_clear_of(offset: float) -> None:
    move = "motion={target=[0.1, -0.3], duration=1.0}"
    table = f"obstacle=[{{kind='halfspace', normal=[0, 1], offset={offset}}}]"
    model = build("paper_forward", [*SCENE[:1], move, *SCENE[2:-1], table])
    explained = explain_model(model)
    texts = [text for text in explained.warnings if "stays" in text]
    assert explained.effects["obstacles"].gate.matters == (offset > -1)
    assert explained.idle == (("obstacles",) if offset == -5 else ())
    touched = simulate(model).contact
    assert touched is not None
    assert len(texts) == (offset == -5)
    assert (touched.columns > 0) == (offset > -1)  # at -0.34 by its deformation alone
    if texts:  # the lowest nodes end 0.3 m below y = 0
        assert "stays 4.7 m from every obstacle" in texts[0]
        assert "estimated at" in texts[0]
        margin = float(texts[0].partition("estimated at ")[2].split()[0])
        assert touched.gap.min() > 4.7 - margin


def test_a_pin_that_only_points_between_nodes_touch_is_not_said_to_be_out_of_reach() -> None:
    pin = "obstacle=[{kind='disc', center=[0.5, -0.05], radius=0.03}]"
    path = ["motion={target=[0.0, -0.04], duration=1.0}", "time={steps=60, end=1.0}"]
    model = build("paper_forward", ["tissue.cells=[1, 2]", "effects.obstacles=true", *path, pin])
    assert simulate(model).contact.touching.any()  # no node comes nearer than 0.4
    assert not [text for text in explain_model(model).warnings if "stays" in text]


def test_a_force_moves_a_hand_that_does_not_feel_the_tissue_onto_a_table() -> None:
    moved = ["tissue.cells=[6, 4]", "motion={drive='force', target=[0.02, -0.02], duration=0.5}", "time.steps=300"]
    run = simulate(build("set_down", moved))
    alone = simulate(build("set_down", [*moved, "effects.obstacles=false", "obstacle=false"]))
    assert run.contact is not None
    first = int(run.contact.force.any(axis=(1, 2)).argmax())  # step that touches
    assert 10 < first < 290
    assert np.array_equal(run.q_s, alone.q_s)  # no force on this hand
    assert np.array_equal(run.outputs[: first + 1], alone.outputs[: first + 1])
    assert abs(run.energy_drift) < 1e-13  # asked for
    assert run.contact.gap.min() > -1e-12 * 0.1  # asked for, of the body


def test_a_body_that_is_all_held_is_refused() -> None:
    model = build("set_down", ["tissue.cells=[4, 3]", "contact={sides=['left', 'right', 'top', 'bottom']}"])
    with pytest.raises(SceneError, match="every node of the boundary lies in the contact zone"):
        simulate(model)


def test_a_run_begins_with_the_warning_of_a_small_obstacle(tmp_path: Path) -> None:
    pin = "obstacle=[{name='pin', kind='disc', center=[0.5, -0.5], radius=0.1, parts=2}]"
    console = Console(record=True, quiet=False, file=io.StringIO())
    result = run_simulate(Path("paper_forward"), tmp_path, [*SCENE[:-1], pin], console, pictures=False)
    assert sum("Obstacle 'pin' is 0.1 m in radius" in text for text in result["warnings"]) == 1
    text = console.export_text()
    assert 0 < text.index("Obstacle 'pin' is 0.1 m") < text.index("energy")


def test_field_files_hold_the_traction_whose_integral_is_the_force(tmp_path: Path) -> None:
    console = Console(quiet=True)
    run_simulate(Path("paper_forward"), tmp_path, SCENE, console, until=50)
    run_simulate(Path("paper_forward"), tmp_path, SCENE, console, resume=True)
    contact = simulate(build("paper_forward", SCENE)).contact
    assert contact is not None
    last = meshio.read(max((tmp_path / "fields-from50").glob("*.vtu")))
    assert not contact.impulse[-1].any()  # which the traction leaves out
    low, traction = np.isclose(last.points[:, 1], 0.0), last.point_data["contact_traction"]
    order = np.argsort(last.points[low, 0])
    x, up = last.points[low, 0][order], traction[low, 1][order]
    hats = np.full(len(x), x[1] - x[0])  # integrals of the shape functions on even edges
    hats[[0, -1]] /= 2
    assert hats @ up == pytest.approx(contact.force[-1, 0, 1], rel=1e-6)  # single precision
    assert getattr(Image.open(tmp_path / "move.gif"), "n_frames", 1) > 2
    assert (tmp_path / "contact.png").stat().st_size > 5000
    disc = "obstacle=[{kind='disc', center=[0.5, -0.53], radius=0.5}]"  # touched by fewer than 1 % of the nodes
    fine = [*SCENE, disc, "tissue.cells=[20, 40]", "time.steps=40", "output.frames=3"]
    if importlib.util.find_spec("pyvista"):
        run_simulate(Path("paper_forward"), tmp_path / "fine", fine, console, pictures=False)
        assert Move(tmp_path / "fine", "contact_traction").range[1] > 0


def test_pictures_show_obstacles_where_they_are() -> None:
    path = "path={velocity=[0.3, 0.0]}"
    disc = f"{{kind='disc', name='disc', center=[-1.0, 0.5], radius=0.2, {path}}}"
    table = SCENE[-1].removeprefix("obstacle=[").removesuffix("]")
    model = build("paper_forward", [*SCENE[:-1], f"obstacle=[{disc}, {table}]"])
    picture = gather_picture(model)
    assert picture is not None
    times, still = np.array([0.0, 1.0]), np.zeros((2, *picture.points.shape))
    push = np.zeros_like(still)
    push[1, 0] = [2000.0, 0.0]  # [Pa]
    move = make_view(picture, still, times, np.column_stack([times, np.zeros((2, 2))]), None, push)
    assert move.low[0] <= -1.2  # the picture takes the disc in
    figure, axes = make_axes(move, 1, captions=False)
    draw_surroundings(axes[0], move, [0, 1])
    legend(figure, move)
    lines = [c for c in axes[0].collections if not isinstance(c, Quiver)]
    middles = [line.get_paths()[0].vertices[:-1].mean(axis=0) for line in lines]
    assert np.allclose(middles[:2], [[-1.0, 0.5], [-0.7, 0.5]])  # after 1 s at 0.3 m/s
    assert len(lines) == 3  # the table, which rests, once
    assert "pressure, at most 2 kPa" in [text.get_text() for text in figure.legends[0].get_texts()]
    (arrows,) = [c for c in axes[0].collections if isinstance(c, Quiver)]
    assert (arrows.N, arrows.V[0]) == (1, 0.0)
    assert arrows.U[0] > 0
    plt.close(figure)


def test_obstacles_in_space_are_drawn_by_the_faces_that_are_seen() -> None:
    balls = (
        "{name='ball', kind='ball', center=[0.02, -0.1, 0], radius=0.01}, "
        "{name='box', kind='box', lo=[0, 0.1, 0], hi=[0.01, 0.11, 0.01]}"
    )
    down = "{name='table', kind='halfspace', normal=[0, 0, 1], offset=-0.02}"
    coarse = ["tissue.cells=[2, 2, 2]", "tissue.order=1", "tissue.refine=false"]
    model = build("block_3d", [*coarse, "effects.obstacles=true", f"obstacle=[{balls}, {down}]"])
    picture = gather_picture(model)
    assert picture is not None
    times, still = np.zeros(1), np.zeros((1, *picture.points.shape))
    move = make_view(picture, still, times, np.zeros((1, 7)), None)
    figure, axes = make_axes(move, 1, captions=False)
    draw_surroundings(axes[0], move, [0])
    ball, box, table = axes[0].collections
    assert (len(ball.get_paths()), len(box.get_paths()), len(table.get_paths())) == (1, 3, 1)
    assert ball.get_zorder() > 2 > box.get_zorder()  # the body has 2; the viewer is at negative y
    corners = table.get_paths()[0].vertices[:4]
    body = seen(picture.points[picture.points[:, 2] == 0] - [0, 0, 0.02])  # the shadow of the body on the table
    assert (corners.min(axis=0) < body.min(axis=0)).all()
    assert (corners.max(axis=0) > body.max(axis=0)).all()
    names = {text.get_text(): text.get_position() for text in axes[0].texts}
    assert {"ball", "box", "table"} <= set(names)  # beside those of the axes
    assert ball.get_paths()[0].contains_point(names["ball"])
    assert any(face.contains_point(names["box"]) for face in box.get_paths())
    frame, place = np.array([axes[0].get_xlim(), axes[0].get_ylim()]).T, np.array(names["table"])
    assert ((frame[0] < place) & (place < frame[1])).all()
    inside = Delaunay(seen(picture.points)).find_simplex(place) >= 0
    assert not inside  # beside the body
    plt.close(figure)
