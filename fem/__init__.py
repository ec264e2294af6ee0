"""Full-order model of a rigid hand that holds soft tissue: scene, mesh, blocks, midpoint run."""

from typing import TYPE_CHECKING

from softgrasp._face import face

if TYPE_CHECKING:
    from softgrasp.fem.accuracy import adapt
    from softgrasp.fem.accuracy.adapt import estimated
    from softgrasp.fem.accuracy.estimate import extrapolated
    from softgrasp.fem.accuracy.price import run_seconds
    from softgrasp.fem.checksums import digest, read_manifest, write_manifest
    from softgrasp.fem.columns import AXES, Array, Columns, OutputColumn, farthest, hand_columns, placed
    from softgrasp.fem.effects import EFFECTS
    from softgrasp.fem.effects.damping import layered
    from softgrasp.fem.effects.finite_strain import linear_error
    from softgrasp.fem.effects.gate import SMALL_SHARE
    from softgrasp.fem.effects.gravity import EARTH
    from softgrasp.fem.errors import (
        ResourceError,
        SceneError,
        SoftgraspError,
        SolverError,
        no_pipe,
        one_line,
        raise_on_all_ranks,
        shortened,
    )
    from softgrasp.fem.fields.hdf import run_of
    from softgrasp.fem.fields.picture import PictureMesh, gather_picture, vertex_displacement
    from softgrasp.fem.fields.probe import Probe, make_probe
    from softgrasp.fem.fields.series import SeriesWriter
    from softgrasp.fem.fields.vtu import Collection, check_file, note_of
    from softgrasp.fem.mesh.scene_hash import scene_hash, scene_keys
    from softgrasp.fem.mesh.singular import Ends, expected_order
    from softgrasp.fem.mesh.tissue_mesh import TissueMesh
    from softgrasp.fem.model.build import MeshEstimate, Model, Stopwatch, build
    from softgrasp.fem.model.memory import free_bytes
    from softgrasp.fem.model.outputs import make_outputs
    from softgrasp.fem.model.refined import scene_ends
    from softgrasp.fem.model.scales import SMALL_STRAIN, rigid_inertia
    from softgrasp.fem.obstacles import Ball, HalfSpace, Obstacle, Polytope, Shape
    from softgrasp.fem.owned import follow, note, remove_own
    from softgrasp.fem.petsc import PETSc, on_root, total
    from softgrasp.fem.reduced import ReducedSystem
    from softgrasp.fem.resources import free_memory, size_text
    from softgrasp.fem.run.forecast import Forecast, forecasts, told
    from softgrasp.fem.run.interrupt import interruptible
    from softgrasp.fem.run.motion import Profile, largest_acceleration, motion_table
    from softgrasp.fem.run.simulate import Run, RunOptions, simulate
    from softgrasp.fem.run.states.checkpoint import check_ranks
    from softgrasp.fem.run.states.frames import FRAMES, frame_count, frame_steps
    from softgrasp.fem.run.states.snapshots import spread
    from softgrasp.fem.run.states.trajectory import Trajectory
    from softgrasp.fem.run.stepping import make_ts
    from softgrasp.fem.scene.control import Loop, Reduction
    from softgrasp.fem.scene.file import find_scene, load_scene, load_scene_collective, resolved_toml
    from softgrasp.fem.scene.materials import LIBRARY, young_poisson
    from softgrasp.fem.scene.scene import Scene, scene_schema
    from softgrasp.fem.scene.table import read_csv
    from softgrasp.fem.scene.text import out_of_range, parse_toml, read_text
    from softgrasp.fem.shown import counted, digits, length_unit, percent
    from softgrasp.fem.solve.costs import STEP_RTOL
    from softgrasp.fem.solve.modes import lowest_modes
    from softgrasp.fem.solve.solvers import ITERATIVE
    from softgrasp.fem.solve.stiffness import sharing_factors
    from softgrasp.fem.system import BlockSystem
else:
    __getattr__, __dir__ = face(__name__)
