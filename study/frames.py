"""What a run leaves for the eye: field files for ParaView while it runs, figures and animation afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fem.build import Model
from fem.fields import SeriesWriter
from fem.gather import gather_picture, vertex_displacement
from fem.petsc import Array
from fem.run import Run, Trajectory, frame_steps

MANY_VERTICES = 200_000  # above, only the instants of the still picture are kept
SHOWN = (0.0, 0.35, 0.65, 1.0)  # instants of the still picture; a rest-to-rest move bends the body most near 1/3, 2/3


class Frames:
    """Observer of a run: writes field files and keeps vertex displacements on rank 0.

    Args:
        model: the model.
        directory: where the field files go.
        pictures: keep what figures and animation need.
    """

    def __init__(self, model: Model, directory: Path, pictures: bool = True) -> None:
        self.model, self.pictures = model, pictures
        self.writer = None
        if model.scene.output.fields != "none":
            self.writer = SeriesWriter(model, directory, model.scene.output.fields)
        self.picture = gather_picture(model) if pictures else None
        vertices = model.space.mesh.mesh.geometry.index_map().size_global
        self.few = vertices > MANY_VERTICES
        grid = frame_steps(model.scene)
        self.chosen = {min(grid, key=lambda n: abs(n - f * grid[-1])) for f in SHOWN}
        self.times: list[float] = []
        self.hands: list[Array] = []
        self.states: list[np.ndarray] = []

    def __call__(self, run: Run) -> None:
        """Take one frame. Collective."""
        n = self.model.system.layout.n_local
        z, v = run.state.array[:n], run.state.array[n:]
        t, q_s, v_s = run.reached * run.dt, run.drive.q[run.reached], run.drive.v[run.reached]
        if self.writer is not None:
            self.writer.write(t, z, v, q_s, v_s)
        if self.pictures and (not self.few or run.reached in self.chosen):
            state = vertex_displacement(self.model, z, q_s)
            self.times.append(t)
            self.hands.append(q_s.copy())
            if state is not None:
                self.states.append(state.astype(np.float32))

    def close(self) -> list[Path]:
        """Finish the field files. Collective."""
        return list(self.writer.close()) if self.writer is not None else []

    def draw(self, directory: Path, run: Trajectory) -> list[Path]:
        """Figures and animation; rank 0 only."""
        from study.animation import gif_move
        from study.plots import figure_move, figure_traces

        scene = self.model.scene
        if self.picture is None or not self.states:
            return []
        table = np.column_stack([run.times, run.q_s])
        target = scene.motion.target
        states = np.stack(self.states)
        times = np.array(self.times)
        chosen = [int(np.argmin(abs(times - run.times[n]))) for n in sorted(self.chosen)]
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
