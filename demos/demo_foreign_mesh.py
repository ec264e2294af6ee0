# %% [markdown]
# # How do I simulate a body that another program meshed?
# The small pillow of deformable-gym (BSD-3-Clause, licence beside the mesh): tetrahedra that nobody here made, held at
# the flat bottom, sagging under gravity. Then the same body with named groups, as Gmsh writes them, carried along poses
# that a robot recorded, and its fields in PyVista. Run it with `python demos/demo_foreign_mesh.py`, or under
# `mpiexec -n 2`.

# %%
from pathlib import Path
from tempfile import mkdtemp

import meshio
import numpy as np
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.scene.file import shipped_scenes

comm = MPI.COMM_WORLD
scenes = shipped_scenes()["pillow_3d"].parent
coarse = {"tissue": {"refine": False, "order": 1}, "time": {"steps": 200}}
run = sg.simulate(sg.build("pillow_3d", **coarse))

# %% [markdown]
# The pillow starts in equilibrium: it sags under its weight and nothing moves before the hand does.

# %%
sag = (run.outputs - run.outputs_rigid)[:, 2]
if comm.rank == 0:
    print(f"a corner sags by {-1e3 * sag[0]:.2f} mm")
assert sag[0] < 0  # gravity pulls down
assert abs(sag[1] - sag[0]) < 1e-3 * abs(sag[0])  # still in equilibrium after one step
assert run.energy_drift < 1e-11  # work, energy and dissipation balance to rounding
run

# %% [markdown]
# Groups in the file name its parts: cells of a stiff core and of the rest, facets of the grip. Here meshio writes what
# Gmsh would, `.msh` with physical groups; `.vtu` keeps the numbers as cell data.

# %%
CORE, REST, GRIP = 1, 2, 3
folder = Path(comm.bcast(mkdtemp() if comm.rank == 0 else None))
with raise_on_all_ranks(comm):
    if comm.rank == 0:
        mesh = meshio.read(scenes / "meshes" / "pillow_small.msh")
        tetra = mesh.get_cells_type("tetra")
        facets, count = np.unique(
            np.sort(np.vstack([np.delete(tetra, i, 1) for i in range(4)])), axis=0, return_counts=True
        )
        skin = facets[count == 1]
        bottom = mesh.points[skin].mean(axis=1)[:, 2] < 0.006
        middle = mesh.points[tetra].mean(axis=1)[:, 1:]
        inside = np.linalg.norm(middle - middle.mean(axis=0), axis=1) < 0.06
        tags = [np.where(inside, CORE, REST).astype(np.int32), np.full(bottom.sum(), GRIP, dtype=np.int32)]
        blocks = [("tetra", tetra), ("triangle", skin[bottom])]
        names = {"core": np.array([CORE, 3]), "rest": np.array([REST, 3]), "grip": np.array([GRIP, 2])}
        gmsh = meshio.Mesh(
            mesh.points, blocks, cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags}, field_data=names
        )
        meshio.write(folder / "pillow.msh", gmsh, file_format="gmsh22")
        meshio.write(folder / "pillow.vtu", meshio.Mesh(mesh.points, blocks, cell_data={"tags": tags}))

# %% [markdown]
# The hand's poses come from a CSV file: time [s], place [m], unit quaternion. Here it lifts by 20 cm and tilts by three
# degrees. `softgrasp new SCENE.toml --mesh pillow.msh` writes such a scene, with comments, from the groups of a mesh.

# %%
SCENE = """
name = "pillow"
effects = { gravity = [0.0, 0.0, -9.81], rotation = true, damping = { kind = "kelvin-voigt", beta = 0.005 } }
hand = { mass = 0.73, inertia = [0.004, 0.004, 0.006] }
contact = { facet_tag = FACETS }
motion = { profile = "csv", csv = "poses.csv" }
time = { steps = 200, end = 1.0, start = "equilibrium" }
control = { outputs = [{ kind = "node", point = [0.135, -0.105, 0.0906], name = "corner" }] }

[tissue]
mesh = "FILE"
material = { young = 2.0e3, poisson = 0.3, rho = 200.0 }
layers.core = { tag = CELLS, material = { young = 2e5, poisson = 0.4, rho = 200.0 } }
"""
t = np.linspace(0.0, 1.0, 11)
rise = t**3 * (10 - 15 * t + 6 * t**2)  # from rest to rest
angle = np.radians(3.0) * rise
poses = np.column_stack([t, 0 * t, 0 * t, 0.2 * rise, np.cos(angle / 2), np.sin(angle / 2), 0 * t, 0 * t])
with raise_on_all_ranks(comm):
    if comm.rank == 0:
        header = "t, x, y, z, qw, qx, qy, qz"
        np.savetxt(folder / "poses.csv", poses, delimiter=", ", header=header, comments="")
        for suffix, grip, core in ((".msh", '"grip"', '"core"'), (".vtu", "3", "1")):
            text = SCENE.replace("FILE", f"pillow{suffix}").replace("FACETS", grip).replace("CELLS", core)
            (folder / f"pillow{suffix}.toml").write_text(text)

model = sg.build(folder / "pillow.msh.toml")
stiff, other = sg.simulate(model), sg.simulate(sg.build(folder / "pillow.vtu.toml"))
start = (stiff.outputs - stiff.outputs_rigid)[0, 2]
difference = np.abs(other.outputs - stiff.outputs).max() / np.abs(stiff.outputs).max()
if comm.rank == 0:
    print(f"with a core a hundred times as stiff it sags by {-1e3 * start:.2f} mm")
    print(f"the hand ends at {stiff.q_s[-1, 2]:.3f} m, tilted by {np.degrees(stiff.q_s[-1, 3]):.2f} degrees")
    print(f".vtu against .msh: relative difference {difference:.1e}")
assert sag[0] < start < 0  # the core carries part of the weight
assert abs(stiff.q_s[-1, 3] - angle[-1]) < 1e-3  # small angles
assert difference < 1e-10  # the same cells and tags, perhaps in another order
stiff.animate(model)

# %% [markdown]
# The fields of an instant for PyVista and ParaView. `softgrasp simulate` writes sixty of them, and `softgrasp view`
# shows them in a window.

# %%
from softgrasp.fem.fields.series import SeriesWriter

z, v = stiff.final.reshape(2, -1)
SeriesWriter(model, folder / "fields").write(1.0, z, v, stiff.q_s[-1], stiff.v_s[-1])

# %%
if comm.rank == 0:
    import os

    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")  # draws without a display
    import matplotlib.pyplot as plt
    import pyvista

    grid = pyvista.PVDReader(str(folder / "fields" / "fields.pvd")).read()[0]
    print(grid.cell_data.keys(), f"von Mises stress at most {grid['von_mises'].max():.0f} Pa")
    assert grid.n_cells == model.cells
    plotter = pyvista.Plotter(off_screen=True, window_size=(900, 500))
    body = grid.warp_by_vector("displacement")
    half = body.clip("y", origin=body.center, invert=False)  # the half behind the cut
    bar = {"title": "von Mises [Pa]", "n_labels": 4, "fmt": "%.0f"}
    ends = [0.0, np.percentile(half["von_mises"], 95)]  # a few cells beside the grip would take all colours
    plotter.add_mesh(half, scalars="von_mises", cmap="viridis", clim=ends, scalar_bar_args=bar)
    plotter.camera_position = "xz"
    plotter.camera.zoom(1.4)
    figure, axis = plt.subplots(figsize=(9, 5), layout="constrained")
    axis.imshow(plotter.screenshot())
    axis.axis("off")
    plotter.close()
