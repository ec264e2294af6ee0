# %% [markdown]
# # Can a reduced model prove its error?
# A certified model answers for a new material, and proves how far the answer is from the full model's at most. Run it
# with `python demos/demo_certified.py`, or under `mpiexec -n 2`.

# %%
import time
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from mpi4py import MPI

import softgrasp as sg
from softgrasp.reduction.certified.trainer import Trainer, build_certified

speak = MPI.COMM_WORLD.rank == 0
model = sg.build(
    "paper_forward",
    tissue={"cells": [6, 12]},
    time={"steps": 200},
    effects={"damping": {"kind": "kelvin-voigt", "beta": 0.002}},
)

# %% [markdown]
# The training adds modes where the bound is largest, until it is below 1 % for every lambda and mu of the box. On the
# command line this is `softgrasp reduce SCENE --tolerance 1e-2`, which writes a file.

# %%
trainer = Trainer(model)
certified = build_certified(trainer, 1e-2)
trainer.destroy()
certified

# %% [markdown]
# A query: new constants, an answer, and its certificate, as `softgrasp query certified.h5 --set lambda=77 --set mu=60`
# gives them.

# %%
materials = tuple(replace(m, lam=77.0, mu=60.0) for m in certified.fine.materials)
begin = time.process_time()
answer = certified.run(materials)
spent = time.process_time() - begin
full = sg.simulate(model.with_materials(lam=77.0, mu=60.0))
if speak:
    proof = answer.certificate
    reduction, time_step = 100 * proof.reduction, 100 * proof.time_step
    print(f"error of the reduction at most {reduction:.2f} %, of the time step about {time_step:.2f} %")
    print(f"{1e3 * spent:.0f} ms of processor time")

# %% [markdown]
# The full model tells the true error, which no query needs: the bound of every output is above it.

# %%
true = np.abs(answer.trajectory.outputs - full.outputs).max(axis=0)
bound = np.atleast_2d(answer.certificate.outputs.values).max(axis=0)
for name, e, b in zip(full.output_names, true, bound, strict=True):
    if speak:
        print(f"{name}: error {e:.2e} m, proved to be at most {b:.2e} m")
assert (true <= bound).all()
assert answer.certificate.reduction < 1e-2

# %% [markdown]
# Over the box: bounds at some materials that trained nothing.

# %%
rng = np.random.default_rng(3)
box = trainer.box
points = np.exp(rng.uniform(np.log([box.lam[0], box.mu[0]]), np.log([box.lam[1], box.mu[1]]), (20, 2)))
many = [tuple(replace(m, lam=lam, mu=mu) for m in certified.fine.materials) for lam, mu in points]
bounds = [certificate.reduction for certificate in certified.certificates(many)]
figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
dots = axis.scatter(*points.T, c=100 * np.array(bounds))
axis.set(xscale="log", yscale="log", xlabel="lambda [Pa]", ylabel="mu [Pa]")
for side, ends in ((axis.xaxis, box.lam), (axis.yaxis, box.mu)):
    ticks = np.geomspace(*ends, 3)
    side.set_ticks(ticks, [f"{tick:.0f}" for tick in ticks])
    side.set_ticks([], minor=True)
figure.colorbar(dots, label="proved error of reduction [%]")
assert max(bounds) < 1.2e-2  # trained on a grid: between its points the bound may pass the tolerance a little
