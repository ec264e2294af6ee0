# %% [markdown]
# # How large is the error of the mesh, and what does the stiffness change?
# The paper's forward scene on its own and on a graded mesh, then the same hand with other tissues: an axpy each, no
# new assembly. Run it with `python demos/demo_forward.py`, or `mpiexec -n 2 python demos/demo_forward.py`.

# %%
import matplotlib.pyplot as plt
from mpi4py import MPI

import softgrasp as sg

model = sg.build("paper_forward")
layout = model.system.layout

# %% [markdown]
# The hand has two unknowns, the tissue 956; the first-order state has 1916 entries, as in the paper.

# %%
assert (layout.n_s, layout.n_e, model.states) == (2, 956, 1916)

# %% [markdown]
# PETSc TS runs the implicit midpoint rule. The hand moves from rest to rest, and the energy balance closes.

# %%
run = sg.simulate(model)
if MPI.COMM_WORLD.rank == 0:
    print("hand", run.q_s[-1], "tip", run.outputs[-1], "energy drift", run.energy_drift)
assert abs(run.q_s[-1] - [5, 3]).max() < 1e-12  # a prescribed motion ends where it should
assert run.energy_drift < 1e-12  # the midpoint rule conserves quadratic invariants: rounding only
run.animate(model)

# %% [markdown]
# The error of the mesh: the same scene on a graded mesh, cells shrinking towards the ends of the contact zone. The
# deformation, the tip against the hand, has an error of 40 % on the paper's mesh, and of 0.1 % on the graded one.

# %%
accurate = sg.simulate(sg.build("paper_accurate"))
coarse, fine = (r.outputs - r.outputs_rigid for r in (run, accurate))
error = abs(coarse - fine).max() / abs(fine).max()
if MPI.COMM_WORLD.rank == 0:
    print(f"on the paper's mesh the deformation has an error of {100 * error:.0f} %")
assert 0.35 < error < 0.45
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for y, mesh in ((coarse, "paper's mesh"), (fine, "graded mesh")):
    axis.plot(run.times if y is coarse else accurate.times, y[:, 1], label=mesh)
axis.set(xlabel="time [s]", ylabel="tip against the hand, y [m]")
axis.legend()

# %% [markdown]
# New material: `K = mu K_mu + lambda K_lambda` is combined again. A stiffer body follows the hand more closely.

# %%
lag = {}
for mu in (20.0, 50.0, 200.0, 500.0):
    stiffer = sg.simulate(model.with_materials(mu=mu))
    lag[mu] = abs(stiffer.outputs - stiffer.outputs_rigid).max()
    if MPI.COMM_WORLD.rank == 0:
        print(f"mu = {mu:5.0f} Pa: the tip lags behind the hand by up to {lag[mu]:.3g} m")
assert sorted(lag.values(), reverse=True) == list(lag.values())
table = sg.sweep("paper_forward", {"tissue.cells": [[8, 16]], "tissue.material.mu": [20, 50, 200, 500]})
assert len(table.to_pandas()) == 4  # the same as a table, with units
assert lag[500.0] < lag[50.0] / 4  # nearly static lag goes with 1 / stiffness; lambda stays, resonance has a share
