# %% [markdown]
# # What does a robot's arm feel when the thing it carries is soft?
# An arm of seven joints in MuJoCo carries a block of soft silicone round and turns it on its side. MuJoCo
# knows rigid bodies, contacts and motors; twelve modes of the block, made from its finite elements, are on the hand and
# solved with the arm in the same step. The arm is made of primitives below. Run it with `python demos/demo_arm.py`.

# %%
import mujoco
import numpy as np
from mpi4py import MPI

import softgrasp as sg

comm = MPI.COMM_SELF  # MuJoCo is serial: under mpiexec every rank does the same
block = {
    "tissue": {"size": [0.06, 0.06, 0.135], "cells": [2, 2, 9], "order": 2, "material": "ecoflex-00-30"},
    "contact": {"sides": ["left", "right"], "box": [[0.0, 0.0, 0.105], [0.06, 0.06, 0.135]]},  # between two fingers
    "control": {"outputs": [{"kind": "node", "point": [0.03, 0.03, 0.0], "name": "tip"}]},
    "time": {"steps": 2, "end": 0.01, "start": "rest"},
}
model = sg.build("turn_over_3d", comm=comm, **block)
rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=36)
small = rom.at(1e-3).small  # mass, stiffness and coupling with the hand in twelve coordinates
slowest = np.sqrt(np.linalg.eigvals(np.linalg.solve(small.M, small.K)).real.min())
print(f"{rom.k} modes for {model.space.layout.n_e} unknowns; the slowest swings at {slowest / (2 * np.pi):.2f} Hz")

# %% [markdown]
# The arm: capsules, spheres and boxes with the masses of an ordinary arm, motors that give torques, and the inertia of
# motors and gears at each joint (`armature`): a wrist without it is so light that a controller at 1 kHz is unstable.
# The last body is the hand. `mujoco_body` gives its mass and that of the block as if it were rigid; its origin is the
# reference point of the hand.

# %%
LENGTHS = [0.3, 0.0, 0.32, 0.0, 0.3, 0.0, 0.1]  # [m] of the links, along z
AXES = ["0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 -1 0", "0 0 1"]
MASSES = [3.0, 1.0, 2.5, 1.0, 2.0, 0.6, 0.4]  # [kg]
ARMATURE = [0.6, 0.6, 0.4, 0.4, 0.2, 0.1, 0.1]  # [kg m^2]
FINGERS = (
    '<geom type="box" size=".02 .05 .02" pos="0 0 .06" mass="0"/>'
    '<geom type="box" size=".006 .02 .04" pos="-.036 0 .025" mass="0"/>'
    '<geom type="box" size=".006 .02 .04" pos=".036 0 .025" mass="0"/>'
    '<geom type="box" size=".042 .02 .006" pos="0 0 .06" mass="0"/>'
)


def arm(h):
    """The robot with the hand at its end, for steps of h."""
    body = f'<body pos="0 0 .07" quat="0 1 0 0">{sg.bridges.mujoco_body(rom, joint="", inside=FINGERS)}</body>'
    for i in reversed(range(7)):
        length = LENGTHS[i]
        shape = f'type="capsule" size=".045" fromto="0 0 0 0 0 {length}"' if length else 'type="sphere" size=".06"'
        body = (
            f'<body><joint name="joint{i}" axis="{AXES[i]}" armature="{ARMATURE[i]}" damping="0.5"/>'
            f'<geom {shape} mass="{MASSES[i]}"/><body pos="0 0 {length}">{body}</body></body>'
        )
    motors = "".join(f'<motor joint="joint{i}"/>' for i in range(7))
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{h}" gravity="0 0 -9.81" integrator="Euler"/>'
        '<default><geom contype="0" conaffinity="0"/></default>'
        f'<worldbody><body pos="0 0 .1"><geom type="cylinder" size=".09 .1" mass="5"/>{body}</body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


# %% [markdown]
# The move: the arm turns by 90 degrees and lays the block on its side, along one smooth curve. The controller is what
# robots have: torques of the rigid model along the plan, and a spring and a damper at each joint. `carry` runs it with
# the tissue, or with the block as if it were rigid.

# %%
HOME = np.array([-0.8, 0.35, 0.0, -1.45, 0.0, -np.pi + 1.8, 0.0])
GOAL = np.array([0.8, 0.55, 0.0, -1.1, 0.0, -np.pi / 2 + 1.65, 0.6])
MOVE, END, h = 0.7, 2.4, 1e-3  # [s]
KP, KD = np.diag([600.0, 600, 600, 600, 250, 150, 100]), np.diag([60.0, 60, 60, 60, 30, 15, 10])
robot = arm(h)
t = h * np.arange(round(END / h) + 1)


def smooth(t, duration):
    """From 0 to 1 in the duration, at rest at both ends."""
    s = np.clip(t / duration, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def carry(way, soft=True):
    """Deformation at the tip, its coordinates, force on the hand, places and axes of all shapes and of the hand."""
    plan = HOME + way[:, None] * (GOAL - HOME)
    speed = np.gradient(plan, h, axis=0)
    ahead, data = mujoco.MjData(robot), mujoco.MjData(robot)
    data.qpos[:] = plan[0]
    tissue = sg.bridges.MujocoTissue(rom, robot, dt=h)
    tissue.settle(data)
    kept = {"tip": [], "a": [], "wrench": [], "places": [], "turns": []}
    for n in range(len(plan) - 1):
        ahead.qpos[:], ahead.qvel[:] = plan[n], speed[n]
        ahead.qacc[:] = (speed[n + 1] - speed[n]) / h
        mujoco.mj_inverse(robot, ahead)  # torques that rigid tissue would need
        data.ctrl[:] = ahead.qfrc_inverse + KP @ (plan[n] - data.qpos) + KD @ (speed[n] - data.qvel)
        tissue.step(data) if soft else mujoco.mj_step(robot, data)
        tip = [tissue.outputs[f"tip_{axis}"] for axis in "xyz"]
        places = np.vstack([data.geom_xpos, data.xpos[tissue.body]])
        turns = np.vstack([data.geom_xmat, data.xmat[tissue.body]]).reshape(-1, 3, 3)
        for name, value in zip(kept, (tip, tissue.a, tissue.wrench, places, turns), strict=True):
            kept[name].append(np.array(value))
    return {name: np.array(values) for name, values in kept.items()}


way = smooth(t, MOVE)
rigid, soft = carry(way, soft=False), carry(way)
late = t[1:] > MOVE + np.pi / slowest  # after this move and the next one
swing = 1e3 * np.ptp(soft["tip"][late], axis=0).max()
most = 1e3 * np.linalg.norm(soft["tip"], axis=1).max()
pulled = 1e3 * np.linalg.norm(soft["places"][:, -1] - rigid["places"][:, -1], axis=1).max()
print(f"the tip is up to {most:.1f} mm from its place in a rigid block; after the move it swings by {swing:.1f} mm")
print(f"the hand is up to {pulled:.2f} mm from where it is with a rigid block")
assert 10 < most < 30  # [mm] of 105 that are free: the linear law still serves
assert pulled > 0.1  # the arm feels it

# %% [markdown]
# The model says how to stop the swing: it knows the period. Half of the move now, the other half half a period later,
# and what the first leaves the second takes away. This costs a tenth of a second.

# %%
shaped = carry((way + smooth(t - np.pi / slowest, MOVE)) / 2)
left = 1e3 * np.ptp(shaped["tip"][late], axis=0).max()
print(f"in two halves {np.pi / slowest:.3f} s apart: it swings by {left:.1f} mm")
assert left < swing / 3

# %% [markdown]
# At rest the arm carries what mechanics says: beside rigid tissue the torque of the weight of the mass that has moved.

# %%
mass = small.G[:, :3].T @ shaped["a"][-1]  # int rho z [kg m]
torque = np.cross(mass, shaped["turns"][-1, -1].T @ [0.0, 0.0, -9.81])
print("torque on the hand [mN m]:", 1e3 * shaped["wrench"][-1, 3:], "of the weight:", 1e3 * torque)
assert np.abs(shaped["wrench"][-1, 3:] - torque).max() < 0.03 * np.abs(torque).max()  # what still swings

# %% [markdown]
# The film, at half speed and without magnification: left the plain move, right the one in two halves. The colour is how
# far the block is from where a rigid one would be [mm].

# %%
import os

if not os.environ.get("DISPLAY"):
    os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")  # draws without a display
import pyvista
from dolfinx.plot import vtk_mesh
from PIL import Image

from softgrasp.study.notebook import Film
from softgrasp.study.pictures.animation import gif_bytes
from softgrasp.study.pictures.style import colour_map

MIDDLE = [0.03, 0.03, 0.12]  # of what the hand holds: its reference point
FIELD = "deformation [mm]"


def outline(i):
    """Shape i of the robot in its own axes."""
    radius, half, _ = size = robot.geom_size[i]
    kind, up = robot.geom_type[i], {"direction": (0, 0, 1), "radius": radius, "resolution": 20}
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return pyvista.Box(np.outer(size, [-1, 1]).ravel())
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return pyvista.Capsule(cylinder_length=2 * half, **up)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return pyvista.Cylinder(height=2 * half, **up)
    return pyvista.Sphere(radius=radius)


def tissue_at(run, n):
    """Surface of the block in space at step n, with its deformation."""
    z = model.displacement(rom.reconstruct(run["a"][n : n + 1])[:, 0], np.zeros(6))
    grid, moved = pyvista.UnstructuredGrid(*vtk_mesh(z.function_space)), z.x.array.reshape(-1, 3)
    grid[FIELD] = 1e3 * np.linalg.norm(moved, axis=1)
    grid.points = run["places"][n, -1] + (grid.points - MIDDLE + moved) @ run["turns"][n, -1].T
    return grid.extract_surface(algorithm="dataset_surface")


def film(runs, end=1.6, every=30):
    """Half as fast as it was."""
    plotter, shown = pyvista.Plotter(off_screen=True, window_size=(760, 420), shape=(1, len(runs)), border=False), []
    for column, (title, run) in enumerate(runs.items()):
        plotter.subplot(0, column)
        plotter.add_text(title, font_size=9, color="black")
        floor = pyvista.Plane(center=(0.1, 0, 0), i_size=1.4, j_size=3)
        plotter.add_mesh(floor, color="#f4f4f4", lighting=False)
        solids = [plotter.add_mesh(outline(i), color="#b4bac4", ambient=0.25) for i in range(robot.ngeom)]
        skin, bar = tissue_at(run, 0), {"fmt": "%.0f", "n_labels": 2, "position_x": 0.3, "position_y": 0.02}
        plotter.add_mesh(skin, scalars=FIELD, cmap=colour_map(), clim=(0, 24), ambient=0.2, scalar_bar_args=bar)
        plotter.camera_position = [(2.6, 0.45, 0.95), (0.2, 0.07, 0.45), (0, 0, 1)]
        plotter.camera.zoom(1.1)
        shown.append((run, solids, skin))
    images, steps = [], range(0, round(end / h), every)
    for n in steps:
        for run, solids, skin in shown:
            for i, solid in enumerate(solids):
                place = np.eye(4)
                place[:3, :3], place[:3, 3] = run["turns"][n, i], run["places"][n, i]
                solid.user_matrix = place
            skin.copy_from(tissue_at(run, n))
        plotter.render()
        images.append(Image.fromarray(plotter.screenshot()))
    plotter.close()
    return Film(gif_bytes(images, [round(2e3 * h * every)] * len(images)))


move = film({"one smooth move": soft, "in two halves": shaped})
move.save("arm.gif")
move
