"""What a run leaves for the eye: field files for ParaView while it runs, figures and animation afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fem.build import Model
from fem.fields import SeriesWriter
from fem.gather import gather_picture, vertex_displacement
from fem.petsc import Array
from fem.run import Run, Trajectory, frame_steps
from study.shapes import pick_instants, way_done

MANY_VERTICES = 200_000  # above, only the instants of the still picture are kept
SHOWN = (0.0, 1 / 3, 2 / 3, 1.0)  # shares of the way, chosen before the run when few instants are kept


class Frames:
    """Observer of a run: writes field files and keeps vertex displacements on rank 0.

    Args:
        model: the model.
        directory: where the field files go.
        pictures: keep what figures and animation need.
        name: of the field files; a resumed run takes another, so that the frames before the stop stay.
    """

    def __init__(self, model: Model, directory: Path, pictures: bool = True, name: str = "fields") -> None:
        self.model, self.pictures = model, pictures
        self.writer = None
        if model.scene.output.fields != "none":
            self.writer = SeriesWriter(model, directory, model.scene.output.fields, name)
        self.picture = gather_picture(model) if pictures else None
        vertices = model.space.mesh.mesh.geometry.index_map().size_global
        self.few = vertices > MANY_VERTICES
        self.chosen: set[int] = set()
        self.times: list[float] = []
        self.hands: list[Array] = []
        self.states: list[np.ndarray] = []

    def __call__(self, run: Run) -> None:
        """Take one frame. Collective."""
        n = self.model.system.layout.n_local
        z, v = run.state.array[:n], run.state.array[n:]
        t, q_s, v_s = run.reached * run.dt, run.drive.q[run.reached], run.drive.v[run.reached]
        if self.few and not self.chosen:
            self.chosen = self._ahead(run)
        if self.writer is not None:
            self.writer.write(t, z, v, q_s, v_s)
        if self.pictures and (not self.few or run.reached in self.chosen):
            state = vertex_displacement(self.model, z, q_s)
            self.times.append(t)
            self.hands.append(q_s.copy())
            if state is not None:
                self.states.append(state.astype(np.float32))

    def _ahead(self, run: Run) -> set[int]:
        """Steps of the still picture before they are reached; the hand's table is known unless forces drive it."""
        grid = frame_steps(self.model.scene)
        times = np.arange(len(run.drive.q), dtype=np.float64)
        done = way_done(np.column_stack([times, run.drive.q]), times[grid])
        return {grid[int(np.argmin(abs(done - share)))] for share in SHOWN[:-1]} | {grid[-1]}

    def close(self) -> list[Path]:
        """Finish the field files. Collective."""
        return list(self.writer.close()) if self.writer is not None else []

    def draw(self, directory: Path, run: Trajectory) -> list[Path]:
        """Figures and animation; rank 0 only."""
        from study.animation import gif_move
        from study.plots import figure_move
        from study.traces import figure_traces

        scene = self.model.scene
        if self.picture is None or not self.states:
            return []
        table = np.column_stack([run.times, run.q_s])
        target = scene.motion.target
        states = np.stack(self.states)
        times = np.array(self.times)
        chosen = list(range(len(times))) if self.few else pick_instants(self.picture, states, times, table)
        files = [*figure_move(self.picture, states[chosen], times[chosen], table, target, directory / "move.png")]
        files += figure_traces(
            run.times,
            run.outputs,
            run.output_names,
            run.q_s,
            directory / "traces.png",
            rigid=run.outputs_rigid,
            dimension=self.picture.dimension,
        )
        if not self.few:
            files.append(gif_move(self.picture, states, times, table, target, directory / "move.gif"))
        return files
