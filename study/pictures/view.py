"""``softgrasp view``: the move of a finished or stopped run, from its field files, with PyVista."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem import Collection, Obstacle, ResourceError, SceneError, check_file, load_scene, no_pipe

SHOWN = 4  # number of bodies in a picture, equally spaced in time, first and last included
OBSTACLE: dict[str, Any] = {"color": "#d0d0d0", "lighting": False, "show_edges": False}
PEAK = 99  # percentile of the field at the end of the colour scale: corners are singular [%]


class Move:
    """The field files of all parts of a run, instant by instant, coloured by a field.

    Attributes:
        times: time of each instant [s].
        field: name of the field.
        flat: whether the body lies in a plane.
        title: name and unit of the field.
        shown: numbers of the instants in a picture.
        range: values of the field at both ends of the colour scale, of a vector its length.

    Raises SceneError: the folder has no field files, or they have no such field; ResourceError: PyVista is missing.
    """

    def __init__(self, folder: Path, field: str) -> None:
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")  # VTK tries X11 first
        try:
            import pyvista
        except ImportError as error:
            raise ResourceError(
                f"PyVista is not installed; pip install 'softgrasp[view]', or open {folder}/fields.pvd in ParaView"
            ) from error
        names = [(path.stem.removeprefix("fields-from"), path) for path in folder.glob("fields-from*.pvd")]
        parts = {int(step): path for step, path in names if step.isdecimal()}
        if (folder / "fields.pvd").exists():
            parts[0] = folder / "fields.pvd"
        series = [entries for step in sorted(parts) if (entries := _series(parts[step]))]
        if not series and any(folder.glob("fields*.vtkhdf")):
            raise SceneError(f"{folder} has VTKHDF files, for ParaView; view reads those of output.fields = 'vtu'")
        if not series:
            raise SceneError(f"{folder} has no field files; name the output folder of simulate or control")
        ends = [entries[0][0] for entries in series[1:]] + [np.inf]
        self._read_file = pyvista.read
        pairs = zip(series, ends, strict=True)
        self._instants = [entry for entries, end in pairs for entry in entries if entry[0] < end]
        self.times, self.field = [t for t, *_ in self._instants], field  # [s]
        first = self._read(0)
        self.flat = first.bounds.z_max == first.bounds.z_min
        known = {*first.point_data.keys(), *first.cell_data.keys()}
        if field not in known:
            raise SceneError(f"--field {field}: the files contain {', '.join(sorted(known))}")
        data = first.GetPointData() if field in first.point_data else first.GetCellData()
        values = data.GetAbstractArray(field)
        unit = values.GetInformation().Get(values.UNITS_LABEL())
        self.title = f"{field} [{unit}]" if unit else field
        self.shown = sorted({round(i) for i in np.linspace(0, len(self.times) - 1, SHOWN)})
        sizes = np.concatenate([self._value(self._read(i)) for i in self.shown])
        # ends of the colours, from the bodies of a picture; for a vector its length counts
        low, high, top = (float(x) for x in (sizes.min(), np.percentile(sizes, PEAK), sizes.max()))
        self.range = low, high if high > low else top  # few nodes may have any, as of contact
        self._obstacles = _obstacles(folder, 2 if self.flat else 3)

    def body(self, i: int) -> Any:
        """The surface of the deformed body at an instant, with the field as `value`."""
        grid = self._read(i)
        (grid.point_data if self.field in grid.point_data else grid.cell_data)["value"] = self._value(grid)
        return grid.warp_by_vector("displacement").extract_surface(algorithm=None, nonlinear_subdivision=1)

    def obstacles(self, i: int) -> Any:
        """The obstacles at an instant as far as they are near the body, in a plane behind it; None without any."""
        if not self._obstacles:
            return None
        from softgrasp.study.pictures.solids import solids  # few scenes have any

        x = np.asarray(self.body(i).points)
        return solids(self._obstacles, self.times[i], np.array([x.min(axis=0), x.max(axis=0)]), self.flat)

    def page(self) -> str:
        """The whole move as a page of the browser; with obstacles as far as they are near the way."""
        from softgrasp.study.pictures.turning import Scene3D  # a window does without

        bodies = [self.body(i).triangulate() for i in range(len(self.times))]
        triangles = bodies[0].faces.reshape(-1, 4)[:, 1:]
        points = np.array([body.points for body in bodies], dtype=np.float64)
        data = [body.point_data if "value" in body.point_data else body.cell_data for body in bodies]
        around: list[np.ndarray] = []
        if self._obstacles:
            from softgrasp.study.pictures.solids import solids  # few scenes have any

            box = np.array([points.min(axis=(0, 1)), points.max(axis=(0, 1))])
            moving = any(obstacle.path is not None for obstacle in self._obstacles)
            for t in self.times if moving else self.times[:1]:
                mesh = solids(self._obstacles, t, box, self.flat)
                faces = None if mesh is None else mesh.triangulate().faces.reshape(-1, 4)[:, 1:]
                around.append(np.zeros((0, 3, 3)) if faces is None else np.asarray(mesh.triangulate().points)[faces])
        return Scene3D(
            triangles, points, np.array([each["value"] for each in data]), self.times,
            [self.label(i) for i in range(len(self.times))], self.title, self.range, around, self.flat,
        ).html()  # fmt: skip

    def label(self, i: int) -> str:
        """Time and place of the hand."""
        hand = np.asarray(self._read(i).field_data["hand"])
        d = 2 if self.flat else 3
        x = np.where(np.abs(hand[:d]) < 1e-3 * np.abs(hand[:d]).max(), 0.0, hand[:d])  # rounding has many digits
        return f"{self.times[i]:.3g} s, hand at\n({', '.join(f'{v:.3g}' for v in x)}) m"

    def _read(self, i: int) -> Any:
        _, file, checks = self._instants[i]
        with _refusing(file):
            check_file(file, checks)
        return self._read_file(file)

    def _value(self, grid: Any) -> np.ndarray:
        values = np.asarray(grid[self.field], dtype=np.float64)
        return values if values.ndim == 1 else np.asarray(np.linalg.norm(values, axis=1))


def _obstacles(folder: Path, d: int) -> tuple[Obstacle, ...]:
    """The obstacles of the scene of a run; none where its file is gone."""
    if not (folder / "scene.toml").exists():
        return ()
    from softgrasp.fem.obstacles import make_obstacles  # few scenes have any

    scene = load_scene(str(folder / "scene.toml"))
    return make_obstacles(scene, d) if scene.obstacle else ()


@contextmanager
def _refusing(file: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SceneError(f"{file} cannot be read ({error.strerror or error}); run the scene again") from None
    except ValueError as error:
        raise SceneError(f"{file} is damaged, or of an earlier version ({error}); run the scene again") from None


def _series(path: Path) -> list[tuple[float, Path, str]]:
    """Times, files and checksums of a list of field files. Raises SceneError: it is damaged."""
    with _refusing(path):
        return Collection.read(no_pipe(path))


def view(folder: Path, field: str, save: Path | None) -> None:
    """Show the move in a window with a time slider, or save a picture of some instants, or a page that turns it.

    Raises SceneError: there is no display, or the file is neither PNG nor HTML, or as for `Move`.
    """
    if save is not None and save.suffix not in (".png", ".html"):
        raise SceneError(f"--save {save}: a picture is a PNG, a page that turns it HTML; end the name in .png or .html")
    move = Move(folder, field)
    if save is not None and save.suffix == ".html":
        save.write_text(move.page(), encoding="utf-8")
        return
    if save is None and "vtkEGL" in os.environ.get("VTK_DEFAULT_OPENGL_WINDOW", ""):
        raise SceneError("there is no display here for a window; give --save move.png")
    import pyvista

    from softgrasp.study.pictures.style import colour_map  # brings Matplotlib, as PyVista does

    bar: dict[str, Any] = {"title": f"{move.title}\n", "color": "black", "n_labels": 3, "fmt": "%.3g"}
    if save is not None:
        bar |= {"position_x": 0.15, "width": 0.65}  # of a quarter of the picture
    look = {
        "scalars": "value", "clim": move.range, "cmap": colour_map(), "ambient": 0.4, "show_edges": True,
        "edge_opacity": 0.2, "scalar_bar_args": bar,
    }  # fmt: skip
    shown = [0] if save is None else move.shown
    plotter = pyvista.Plotter(off_screen=save is not None, shape=(1, len(shown)), window_size=(1280, 640), border=False)
    for column, i in enumerate(shown):
        plotter.subplot(0, column)
        body = move.body(i)
        plotter.add_mesh(body, name="body", show_scalar_bar=column == 0, **look)
        if (around := move.obstacles(i)) is not None:
            plotter.add_mesh(around, name="obstacles", **OBSTACLE)
        if move.flat:
            plotter.view_xy()
        if save is not None:
            plotter.add_title(move.label(i), font_size=9, color="black")

    if save is None:

        def show(t: float) -> None:
            i = int(np.argmin(np.abs(np.array(move.times) - t)))
            plotter.add_mesh(move.body(i), name="body", reset_camera=False, **look)
            if (around := move.obstacles(i)) is not None:
                plotter.add_mesh(around, name="obstacles", reset_camera=False, **OBSTACLE)

        plotter.add_slider_widget(show, (move.times[0], move.times[-1]), value=move.times[0], title="time [s]")
    plotter.show(screenshot=None if save is None else str(save))
