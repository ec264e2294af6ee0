"""Figures of objects for a notebook: what their ``plot``, ``bode``, ``plot_errors``, ``animate`` and ``view3d`` return.

Figures belong to no window: a notebook shows them where they are the last value of a cell, ``savefig`` writes them.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg

from softgrasp.fem import Array, Model, OutputColumn, PictureMesh, ReducedSystem, SoftgraspError, Trajectory, percent
from softgrasp.fem.fields.picture import gather_picture, vertex_displacement, vertex_values
from softgrasp.fem.labelled import package
from softgrasp.fem.run.states.snapshots import FILMED, spread
from softgrasp.lqr import LoopMargins, LoopTrajectory
from softgrasp.reduction import ReducedModel, ReducedTrajectory, online
from softgrasp.reduction.reduce import errors, replay
from softgrasp.reduction.replay import full_run, replay_inputs
from softgrasp.study.control.plots import bode
from softgrasp.study.pictures import histories, move_bytes
from softgrasp.study.pictures.contact import contact_figure
from softgrasp.study.pictures.style import CYCLE, FULL, WIDTH, length_unit, log_axis, paper_style
from softgrasp.study.pictures.traces import traces
from softgrasp.study.pictures.turning import Scene3D
from softgrasp.study.pull.page import pull_page
from softgrasp.study.reduce.linear.plots import QUANTITIES, errors_figure
from softgrasp.study.reduce.linear.result import MethodSweep

FREE = 1e-4  # of the slowest pole of the tissue: a slower one of the hand is its free motion, a zero but for rounding
FREQUENCIES = 800  # of a Bode diagram, even in log w


def _free(figure: Any) -> Any:
    """The figure without its window, else a notebook would show it twice."""
    plt.close(figure)
    return figure


def trajectory(run: Trajectory) -> Any:
    """Hand and outputs over time. Not collective."""
    return _free(traces(run.times, run.outputs, run.columns, run.q_s, rigid=run.outputs_rigid, dimension=_space(run)))


def reduced(run: ReducedTrajectory) -> Any:
    """Hand and outputs over time. Not collective."""
    columns = tuple(OutputColumn(*name.rpartition("_")[::2]) for name in run.output_names)
    return _free(traces(run.times, run.outputs, columns, run.q_s))


def loop(run: LoopTrajectory) -> Any:
    """Outputs and inputs over time. Not collective."""
    return _free(histories(run.times, run.outputs, run.inputs, run.columns, dimension=_space(run)))


def contact(run: Trajectory | LoopTrajectory) -> Any:
    """Force, gap and touching nodes of each obstacle over time. Not collective.

    Raises SoftgraspError: the scene has no obstacles.
    """
    if run.contact is None:
        raise SoftgraspError("the run had no obstacles; set effects.obstacles and [[obstacle]]")
    return _free(contact_figure(run.times, run.contact))


def loop_bode(margins: LoopMargins) -> Any:
    """Gain and phase of the loop at each input. Not collective."""
    return _free(bode(margins))


def _space(run: Trajectory | LoopTrajectory) -> int:
    return 3 if any(column.axis == "z" for column in run.columns) else 2


def system_bode(system: ReducedSystem) -> Any:
    """Gain |C (i w E - A)^-1 B| and phase from each input to each output. Not collective."""
    sizes = np.sort(np.abs(scipy.linalg.eigvals(system.A, system.E)))
    sizes = sizes[np.isfinite(sizes)]
    free, rest = sizes[: 2 * system.n_s], sizes[2 * system.n_s :]
    sizes = np.append(free[free > FREE * rest.min(initial=np.inf)], rest) if len(rest) else free
    omega = np.geomspace(0.1 * sizes.min(), 10 * sizes.max(), FREQUENCIES)
    H = system.transfer(1j * omega)
    with paper_style():
        figure, (gain, phase) = plt.subplots(2, 1, figsize=(WIDTH, 0.6 * WIDTH), sharex=True, layout="constrained")
        for k, (i, j) in enumerate(np.ndindex(H.shape[1:])):
            if np.abs(H[:, i, j]).max() < 1e-12 * np.abs(H).max():
                continue  # coupled by rounding alone
            name, look = (
                f"{system.inputs[j]} to {system.outputs[i]}",
                {"color": CYCLE[k % 4], "ls": ("-", "--")[k // 4 % 2]},
            )
            gain.loglog(omega, np.abs(H[:, i, j]), label=name, **look)
            phase.semilogx(omega, np.degrees(np.unwrap(np.angle(H[:, i, j]))), **look)
        gain.set_ylabel("gain [output unit / input unit]")
        phase.set(xlabel="frequency [rad/s]", ylabel="phase [deg]")
        gain.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _free(figure)


def model_errors(rom: ReducedModel, model: Model, run: Trajectory) -> Any:
    """Outputs relative to the hand of both runs, and their difference over the largest of them. Collective."""
    small = replay(rom, model, run)
    error = errors(rom, small, model, run).error_deformation
    full, answer = run.outputs - run.outputs_rigid, small.outputs - run.outputs_rigid
    scale = float(np.linalg.norm(full, axis=1).max()) or 1.0
    factor, unit = length_unit(float(np.abs(full).max(initial=0.0)))
    with paper_style():
        figure, (top, below) = plt.subplots(2, 1, figsize=(WIDTH, 0.55 * WIDTH), sharex=True, layout="constrained")
        for i, name in enumerate(run.output_names):
            top.plot(run.times, factor * answer[:, i], color=CYCLE[i % len(CYCLE)], label=f"{name}, N = {rom.N}")
        lines = top.plot(run.times, factor * full, **{**FULL, "zorder": 3})
        lines[0].set_label("full model")
        below.plot(run.times[1:], np.linalg.norm(answer - full, axis=1)[1:] / scale, color=CYCLE[0])
        log_axis(below, None)
        top.set_ylabel(f"relative to hand [{unit}]")
        below.set(xlabel="time [s]", ylabel="error over largest output [1]")
        top.set_title(f"{rom.name}: {percent(error)} of the deformation and its rate, over the whole body")
        top.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _free(figure)


def table_errors(sweeps: Sequence[MethodSweep]) -> Any:
    """Error of the deformation against N, a curve a basis. Not collective."""
    return _free(errors_figure([s for s in sweeps if s.points], QUANTITIES[:1]))


def explorer(rom: ReducedModel, model: Model, run: Trajectory, span: float) -> Any:
    """Sliders of lambda and mu of each layer above the outputs of a reduced model. Not collective: one rank."""
    if not 1 < span < np.inf:
        raise SoftgraspError(f"span = {span:g} must be a ratio above 1, such as 10")
    widgets, full, own = package("ipywidgets"), full_run(model, run), model.system.materials
    sliders = {}
    for i, (blocks, material) in enumerate(zip(model.system.layers, own, strict=True)):
        for key, name in (("lam", "lambda"), ("mu", "mu")):
            if (value := getattr(material, key)) > 0 and not material.part:
                low, high = np.log10([value / span, value * span])
                label = f"{name} [Pa]" if len(own) == 1 else f"{blocks.name} {name} [Pa]"
                sliders[f"{key} {i}"] = widgets.FloatLogSlider(value, min=low, max=high, description=label)

    display: Any = import_module("IPython.display").display  # a notebook has it, ipywidgets need it

    def show(**values: float) -> None:
        materials = tuple(
            replace(m, **{key: values.get(f"{key} {i}", getattr(m, key)) for key in ("lam", "mu")})
            for i, m in enumerate(own)
        )
        step, drive = replay_inputs(rom, rom.at(materials), full)
        display(reduced(online.run(step, **drive)))

    return widgets.VBox([*sliders.values(), widgets.interactive_output(show, sliders)])


def _written(file: str | Path, content: bytes) -> Path:
    """The file, written where there is something: what rank 0 drew is not replaced by another rank's nothing."""
    if content:
        Path(file).write_bytes(content)
    return Path(file)


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"


@dataclass(frozen=True)
class Film:
    """An animated picture; notebooks show it."""

    gif: bytes  # the file

    def save(self, file: str | Path) -> Path:
        """Write it as GIF and return its path; an empty film, of a rank above 0, writes nothing."""
        return _written(file, self.gif)

    def __repr__(self) -> str:
        return f"Film of {_size(len(self.gif))}; save it by film.save('move.gif')"

    def _repr_html_(self) -> str:
        return f'<img alt="the move" src="data:image/gif;base64,{base64.b64encode(self.gif).decode()}">'


@dataclass(frozen=True)
class View:
    """A move to turn, zoom and play; notebooks show it."""

    html: str  # the page

    def save(self, file: str | Path) -> Path:
        """Write it as a page of the browser and return its path; an empty page, of a rank above 0, writes nothing."""
        return _written(file, self.html.encode())

    def __repr__(self) -> str:
        return f"View of {_size(len(self.html))}; save it by view.save('move.html')"

    def _repr_html_(self) -> str:
        look = 'style="width:100%;height:30rem;border:0" title="the move, to turn and play"'
        return f'<iframe {look} srcdoc="{html.escape(self.html)}"></iframe>'


def view3d(run: Trajectory | LoopTrajectory, model: Model) -> View:
    """The move to turn, zoom and play, without obstacles. Collective; rank 0 draws, the others get an empty page.

    Raises SoftgraspError: the run kept no snapshots.
    """
    picture, states, hands, times = _shown(run, model)
    if picture is None or states is None:
        return View("")
    sizes = np.array([np.linalg.norm(u - picture.rigid(q), axis=1) for u, q in zip(states, hands, strict=True)])
    factor, unit = length_unit(float(sizes.max()))
    flat = picture.dimension == 2
    points = np.pad(picture.points + states.astype(np.float64), ((0, 0), (0, 0), (0, 3 - picture.dimension)))
    return View(
        Scene3D(
            picture.cells if flat else picture.facets, points, factor * sizes, list(times),
            [f"{t:.3g} s" for t in times], f"displacement relative to the hand [{unit}]",
            (0.0, factor * float(sizes.max())), flat=flat,
        ).html()
    )  # fmt: skip


def pulled(rom: ReducedModel, model: Model) -> View:
    """The hand to pull with the mouse. Collective; rank 0 draws, the others get an empty page."""
    return View(pull_page(rom, model))


def animation(run: Trajectory | LoopTrajectory, model: Model) -> Film:
    """The move as an animated picture, of a free run with its target, at obstacles with the pressure of contact.

    Collective; rank 0 draws, the others get nothing.

    Raises SoftgraspError: the run kept no snapshots.
    """
    picture, states, _, times = _shown(run, model)
    tractions = _tractions(run, model)
    if picture is None or states is None:
        return Film(b"")
    table: Array = np.column_stack([run.times, run.q_s])
    target = model.scene.motion.target if isinstance(run, Trajectory) else None  # a loop may go elsewhere
    return Film(move_bytes(picture, states, times, table, target, tractions))


def _tractions(run: Trajectory | LoopTrajectory, model: Model) -> Array | None:
    """Pressure of contact at the vertices at the instants of `_shown`, (k, n, d) [Pa]; None without. Collective."""
    if run.contact is None or not run.contact.pressing.any():
        return None
    from softgrasp.fem.fields.traction import ContactTraction  # only runs with contact pay for it
    from softgrasp.fem.run.contact.general import contact_surface

    traction, surface = ContactTraction(model), contact_surface(model)
    every = [vertex_values(model, traction(surface, forces)) for forces in run.contact.pressing]
    there = [values for values in every if values is not None]  # on rank 0
    return np.stack(there) if there else None


def _shown(run: Trajectory | LoopTrajectory, model: Model) -> tuple[PictureMesh | None, Array | None, Array, Array]:
    """The body, displacements (k, n, d) [m], hands (k, n_s) and times (k,) [s] of at most 60 instants. Collective."""
    kept = run.snapshots
    if kept is None:
        cure = "set output.snapshots" if isinstance(run, Trajectory) else "give its LoopOptions snapshots"
        raise SoftgraspError(f"the run kept no snapshots in memory; {cure} = 'memory'")
    pick = spread(len(kept.steps), FILMED)
    n = kept.layout.n_local
    states = vertex_displacement(model, kept.Z[:n, pick], kept.q_s[:, pick])
    return gather_picture(model), states, kept.q_s[:, pick].T, kept.times[pick]
