# %% [markdown]
# # From a scene to a trajectory
# The paper's forward scene, then the same hand with a stiffer tissue: an axpy, no new assembly.
# Run it with `python demos/demo_forward.py`, or `mpiexec -n 2 python demos/demo_forward.py`.

# %%
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene

comm = MPI.COMM_WORLD
scene = load_scene(Path(__file__).parent / "scenes" / "paper_forward.toml")
model = build(scene, comm=comm)
layout = model.system.layout

# %% [markdown]
# The hand has two unknowns, the tissue 956; the first-order state has 1916 entries, as in the paper.

# %%
assert (layout.n_s, layout.n_e, layout.states) == (2, 956, 1916)

# %% [markdown]
# PETSc TS runs the implicit midpoint rule. The hand moves from rest to rest, and the energy balance closes.

# %%
run = simulate(model)
if comm.rank == 0:
    print("hand", run.q_s[-1], "tip", run.outputs[-1], "energy drift", run.energy_drift)
assert abs(run.q_s[-1] - [5, 3]).max() < 1e-12  # a prescribed motion ends where it should
assert run.energy_drift < 1e-12  # the midpoint rule conserves quadratic invariants: rounding only

# %% [markdown]
# New material: $K = \mu K_\mu + \lambda K_\lambda$ is combined again. A stiffer body follows the hand more closely.

# %%
(material,) = model.system.materials
stiff = model.system.with_materials((replace(material, lam=500.0, mu=500.0),))
stiffer = simulate(replace(model, system=stiff))
soft_lag, stiff_lag = (abs(r.outputs - r.outputs_rigid).max() for r in (run, stiffer))
if comm.rank == 0:
    print(f"largest lag of the tip behind the hand: {soft_lag:.3g} m soft, {stiff_lag:.3g} m ten times stiffer")
assert stiff_lag < soft_lag / 5  # nearly static lag goes with 1 / stiffness; resonance may take a part
