# %% [markdown]
# # A mesh from elsewhere
# The small pillow of deformable-gym (BSD-3-Clause, licence beside the mesh): tetrahedra that nobody here made, held at
# the flat bottom, sagging under gravity, lifted; Kelvin-Voigt damping damps the vibration.
# Then the same body with marks, cell tags for a stiff core and facet tags for the bottom, from `.msh`
# and from `.vtu`.

# %%
from pathlib import Path
from tempfile import mkdtemp

import meshio
import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, shipped_scenes

comm = MPI.COMM_WORLD
scenes = shipped_scenes()["pillow_3d"].parent
scene = load_scene(scenes / "pillow_3d.toml", ["tissue.refine=false", "tissue.order=1", "time.steps=200"])
model = build(scene, comm=comm)
run = simulate(model)

# %% [markdown]
# The pillow starts in equilibrium: it sags under its weight and nothing moves before the hand does.

# %%
sag = (run.outputs - run.outputs_rigid)[:, 2]
if comm.rank == 0:
    print(f"n_e = {model.system.layout.n_e}; a corner sags by {-1e3 * sag[0]:.2f} mm")
assert sag[0] < 0  # gravity pulls down
assert abs(sag[1] - sag[0]) < 1e-3 * abs(sag[0])  # still in equilibrium after one step
assert run.energy_drift < 1e-11  # work, energy and dissipation balance to rounding

# %% [markdown]
# Marks in the file name its parts: a layer has its cells by tag, the contact zone its facets. meshio reads many
# formats; `.msh` keeps the tags as physical groups, `.vtu` as cell data.

# %%
CORE, REST, HELD = 1, 2, 3
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
        tags = [np.where(inside, CORE, REST).astype(np.int32), np.full(bottom.sum(), HELD, dtype=np.int32)]
        blocks = [("tetra", tetra), ("triangle", skin[bottom])]
        for suffix, data in ((".msh", {"gmsh:physical": tags, "gmsh:geometrical": tags}), (".vtu", {"tags": tags})):
            marked = meshio.Mesh(mesh.points, blocks, cell_data=data)
            meshio.write(folder / f"pillow{suffix}", marked, **({"file_format": "gmsh22"} if suffix == ".msh" else {}))

changes = ["tissue.refine=false", "tissue.order=1", "time.steps=200", "contact={facet_tag=3}"]
changes += ["tissue.layers.core={tag=1, material={young=2e5, poisson=0.4, rho=200.0}}"]
marked = {}
for suffix in (".msh", ".vtu"):
    file = (folder / f"pillow{suffix}").as_posix()
    model = build(load_scene(scenes / "pillow_3d.toml", [*changes, f"tissue.mesh='{file}'"]), comm=comm)
    marked[suffix] = simulate(model)
stiff = (marked[".msh"].outputs - marked[".msh"].outputs_rigid)[0, 2]
difference = np.abs(marked[".vtu"].outputs - marked[".msh"].outputs).max() / np.abs(run.outputs).max()
if comm.rank == 0:
    print(f"with a core a hundred times as stiff it sags by {-1e3 * stiff:.2f} mm")
    print(f".vtu against .msh: relative difference {difference:.1e}")
assert sag[0] < stiff < 0  # the core carries part of the weight
assert difference < 1e-10  # the same cells and tags, perhaps in another order
