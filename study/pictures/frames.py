"""Pictures of a run: field files for ParaView while it runs, figures and animation afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem import Array, Model, Run, SeriesWriter, Trajectory, frame_steps, note_of, remove_own, total
from softgrasp.fem.checksums import AGAIN, read_arrays, write_arrays
from softgrasp.fem.errors import CheckpointError, raise_on_all_ranks
from softgrasp.fem.fields.picture import gather_picture, vertex_displacement, vertex_values
from softgrasp.study.pictures.shapes import path_fraction

if TYPE_CHECKING:
    from softgrasp.fem.fields.traction import ContactTraction

MANY_VERTICES = 50_000  # above, only the instants of the still picture are kept
LARGE_RESTART = 2**26  # bytes: no room is kept for a larger restart file, it would stop runs that end well
SHOWN = (0.0, 1 / 3, 2 / 3, 1.0)  # shares of the way, chosen before the run when few instants are kept


class Frames:
    """Observer of a run: writes field files and keeps vertex displacements on rank 0.

    A run that is stopped and resumed leaves one field series a leg, named by the step it starts from. What the pictures
    need lies beside its checkpoint, one small file a frame.
    """

    def __init__(self, model: Model, directory: Path, pictures: bool = True) -> None:
        self.model, self.directory, self.pictures = model, directory, pictures
        self.writer = _writer(model, directory)
        self.legs = [0]
        self.foreign = False  # another run wrote in place of the field files of an earlier leg; rank 0 only
        self.saved = 0  # of the frames below, how many lie beside the checkpoint
        self.steps: list[int] = []
        # of the frame with the largest displacement since the start or resume: |z|^2, time [s], z (local rows)
        self.most: tuple[float, float, Array] = (-1.0, 0.0, np.zeros(0))
        self.picture = gather_picture(model) if pictures else None
        vertices = model.space.mesh.mesh.geometry.index_map().size_global
        self.few = vertices > MANY_VERTICES
        self.chosen: set[int] = set()
        self.times: list[float] = []
        self.hands: list[Array] = []
        self.states: list[np.ndarray] = []
        self.tractions: list[np.ndarray] = []  # of contact at the vertices, where the scene has it
        self.traction: ContactTraction | None = None
        if model.scene.effects.obstacles:
            from softgrasp.fem.fields.traction import ContactTraction  # only scenes with contact pay for it

            self.traction = ContactTraction(model)

    def begin(self, run: Run) -> None:
        """Join the legs that led here: field files get their name, pictures what lies beside the checkpoint.

        Collective. Raises CheckpointError: a frame is damaged or gone.
        """
        self.legs = run.legs
        if self.writer is not None:
            self.writer.rename(_series(run.begun), run.name)
        with raise_on_all_ranks(run.layout.comm):
            if run.layout.comm.rank == 0:
                self._remove_series(run)
            if self.picture is not None and run.begun:  # rank 0
                self._load(run)

    def _remove_series(self, run: Run) -> None:
        """Field files that this run did not leave on its way here: those of another run in the same folder."""
        own = [_series(leg) for leg in run.legs[:-1]]
        for path in self.directory.glob("fields*.pvd"):
            if not (path.stem == "fields" or path.stem.removeprefix("fields-from").isdecimal()):
                continue
            if path.stem in own and note_of(path) == run.name:
                continue
            self.foreign = self.foreign or path.stem in own
            remove_own(self.directory, path.with_suffix(""), path)
        for path in self.directory.glob("fields*-*.vtkhdf"):
            from softgrasp.fem.fields.hdf import run_of  # brings h5py

            left = path.stem.rsplit("-", 1)[0] in own
            if left and run_of(path) == run.name:
                continue
            self.foreign = self.foreign or left
            remove_own(self.directory, path)

    def _load(self, run: Run) -> None:
        frames = [
            read_arrays(self.directory / "checkpoint" / name, sha256, "resume with --no-pictures, or " + AGAIN)
            for name, sha256 in run.beside.items()
        ]
        for frame in sorted(frames, key=lambda frame: int(frame["step"])):
            self.steps.append(int(frame["step"]))
            self.times.append(float(frame["t"]))
            self.hands.append(frame["hand"])
            self.states.append(frame["state"])
            if "traction" in frame:
                self.tractions.append(frame["traction"])
        self.saved = len(self.steps)

    def keep(self, run: Run) -> None:
        """Write the new frames beside the checkpoint that is about to be written. Collective.

        Raises CheckpointError: they cannot be written.
        """
        with raise_on_all_ranks(run.layout.comm):
            if run.layout.comm.rank > 0:
                return
            try:
                for i in range(self.saved, len(self.states)):
                    name = f"{run.name}-frame{self.steps[i]}.npz"
                    frame = {"step": self.steps[i], "t": self.times[i], "hand": self.hands[i], "state": self.states[i]}
                    frame |= {"traction": self.tractions[i]} if self.tractions else {}
                    run.beside[name] = write_arrays(self.directory / "checkpoint" / name, frame)
            except OSError as error:
                text = f"{self.directory}: the frames cannot be written ({error}); free the disk"
                raise CheckpointError(text) from error
            self.saved = len(self.states)

    def lacking(self, begun: int) -> int:
        """How many frames before a step the pictures must do without; rank 0 only."""
        if self.picture is None or self.few:
            return 0
        expected = sum(step <= begun for step in frame_steps(self.model.scene, self.model.system.layout.n_e))
        return max(0, expected - len(self.steps))

    def __call__(self, run: Run) -> None:
        """Take one frame. Collective."""
        n = self.model.system.layout.n_local
        z, v = run.state.array[:n], run.state.array[n:]
        t, q_s, v_s = run.reached * run.dt, run.drive.q[run.reached], run.drive.v[run.reached]
        if self.few and not self.chosen:
            self.chosen = self._ahead(run)
        size = float(total(run.layout.comm, np.array([np.dot(z, z)]))[0])
        if size > self.most[0]:
            self.most = size, t, z.copy()
        traction = None
        if self.traction is not None and run.contact is not None:
            traction = self.traction(run.contact.surface, run.contact.pressing())
        if self.pictures and (not self.few or run.reached in self.chosen):
            state = vertex_displacement(self.model, z, q_s)
            self.steps.append(run.reached)
            self.times.append(t)
            self.hands.append(q_s.copy())
            if state is not None:
                self.states.append(state.astype(np.float32))
            if traction is not None and (at_vertices := vertex_values(self.model, traction)) is not None:
                self.tractions.append(at_vertices.astype(np.float32))
        if self.writer is not None:  # last: when there is no room, the rest goes beside the restart file
            reserve = run.layout.comm.allreduce(run.restart_state().size) if isinstance(run, Run) else 0
            reserve = reserve if reserve < LARGE_RESTART else 0
            self.writer.write(t, z, v, q_s, v_s, traction=traction, reserve=reserve)

    def _ahead(self, run: Run) -> set[int]:
        """Steps of the still picture before they are reached; the hand's table is known unless forces drive it."""
        grid = frame_steps(self.model.scene, self.model.system.layout.n_e)
        times = np.arange(len(run.drive.q), dtype=np.float64)
        done = path_fraction(np.column_stack([times, run.drive.q]), times[grid])
        return {grid[int(np.argmin(abs(done - share)))] for share in SHOWN[:-1]} | {grid[-1]}

    def close(self) -> list[Path]:
        """Finish the field files; those of all legs. Collective."""
        own = list(self.writer.close()) if self.writer is not None else []
        earlier = []
        for stem in map(_series, self.legs[:-1]):
            hdf = sorted(self.directory.glob(f"{stem}-*.vtkhdf"))
            earlier += [path for path in [self.directory / f"{stem}.pvd"] if path.exists()]
            earlier += [path for path in hdf if path.stem.rsplit("-", 1)[0] == stem]
        return earlier + own

    def draw(self, directory: Path, run: Trajectory) -> list[Path]:
        """Figures and animation; rank 0 only."""
        if self.picture is None or not self.states:
            return []
        from softgrasp.study.pictures.animation import gif_move  # these bring Matplotlib
        from softgrasp.study.pictures.background import draw_in_background
        from softgrasp.study.pictures.body import figure_move
        from softgrasp.study.pictures.style import save
        from softgrasp.study.pictures.traces import traces

        picture, target = self.picture, self.model.scene.motion.target
        table, states, times = np.column_stack([run.times, run.q_s]), np.stack(self.states), np.array(self.times)
        tractions = np.stack(self.tractions) if self.tractions else None

        def moving(out: Path) -> list[Path]:
            return [] if self.few else [gif_move(picture, states, times, table, target, out / "move.gif", tractions)]

        moved = draw_in_background(self.model.system.layout.comm, directory, moving)
        files = [*figure_move(picture, states, times, table, target, directory / "move.png", tractions)]
        rigid, d = run.outputs_rigid, picture.dimension
        figure = traces(run.times, run.outputs, run.columns, run.q_s, rigid=rigid, dimension=d)
        files += save(figure, directory / "traces.png")
        if run.contact is not None:
            from softgrasp.study.pictures.contact import figure_contact

            files += figure_contact(run.times, run.contact, directory / "contact.png")
        return [*files, *moved()]


def _series(begun: int) -> str:
    """Stem of the field files of the leg that starts from a step."""
    return f"fields-from{begun}" if begun else "fields"


def _writer(model: Model, directory: Path) -> SeriesWriter | None:
    """The writer of the scene's ``output.fields``; None for none. Collective."""
    kind = model.scene.output.fields
    if kind == "vtkhdf":
        from softgrasp.fem.fields.hdf import HdfWriter  # brings h5py

        return HdfWriter(model, directory)
    return SeriesWriter(model, directory) if kind == "vtu" else None
