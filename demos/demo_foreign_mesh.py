# %% [markdown]
# # A mesh from elsewhere
# The small pillow of deformable-gym (BSD-3-Clause, licence beside the mesh): tetrahedra that nobody here made, gripped
# at the waist, hanging under gravity, lifted; Kelvin-Voigt damping takes the vibration out.
# The same body is read once from `.msh` and once from `.vtu`.

# %%
from pathlib import Path
from tempfile import mkdtemp

import meshio
import numpy as np
from mpi4py import MPI

from fem.build import build
from fem.errors import agree
from fem.run import simulate
from fem.scene_file import load_scene

comm = MPI.COMM_WORLD
scenes = Path(__file__).parent / "scenes"
scene = load_scene(scenes / "pillow_3d.toml", ["tissue.order=1", "time.steps=200"])
model = build(scene, comm)
run = simulate(model)

# %% [markdown]
# The pillow starts in equilibrium: it sags under its weight and nothing moves before the hand does.

# %%
sag = (run.outputs - run.outputs_rigid)[:, 2]
if comm.rank == 0:
    print(f"n_e = {model.system.layout.n_e}; the end hangs {-1e3 * sag[0]:.2f} mm below its unloaded place")
assert sag[0] < 0  # gravity pulls down
assert abs(sag[1] - sag[0]) < 1e-3 * abs(sag[0])  # still in equilibrium after one step
assert run.energy_drift < 1e-11  # work, energy and dissipation balance to rounding

# %% [markdown]
# meshio reads many formats. Written as `.vtu` and read again, the mesh gives the same run.

# %%
folder = Path(comm.bcast(mkdtemp() if comm.rank == 0 else None))
with agree(comm):
    if comm.rank == 0:
        mesh = meshio.read(scenes / "meshes" / "pillow_small.msh")
        meshio.write(folder / "pillow.vtu", meshio.Mesh(mesh.points, [("tetra", mesh.get_cells_type("tetra"))]))
file = (folder / "pillow.vtu").as_posix()
changes = ["tissue.order=1", "time.steps=200", f"tissue.mesh='{file}'"]
again = simulate(build(load_scene(scenes / "pillow_3d.toml", changes), comm))
difference = np.abs(again.outputs - run.outputs).max() / np.abs(run.outputs).max()
if comm.rank == 0:
    print(f".vtu against .msh: relative difference {difference:.1e}")
assert difference < 1e-10  # the same cells, perhaps in another order
