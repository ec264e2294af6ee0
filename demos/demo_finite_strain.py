# %% [markdown]
# # When does linear elasticity no longer hold?
# The paper's own move, by linear elasticity and by a neo-Hookean law, and what a reduced model at finite strain costs
# and leaves. Run it with `python demos/demo_finite_strain.py`, or under `mpiexec -n 2`.

# %%
import matplotlib.pyplot as plt
import numpy as np
from mpi4py import MPI

import softgrasp as sg

speak = MPI.COMM_WORLD.rank == 0
small = {"tissue": {"cells": [8, 16]}, "time": {"steps": 300}}
linear = sg.build("paper_forward", **small)
strained = sg.build("paper_forward", effects={"finite_strain": {"law": "neo-hooke"}}, **small)
linear_run, strained_run = sg.simulate(linear), sg.simulate(strained)
strained_run

# %% [markdown]
# The tip against the hand, by both laws. Linear elasticity swells a body that turns or stretches much; the run warns
# where it no longer holds.

# %%
relative = {name: run.outputs - run.outputs_rigid for name, run in (("linear", linear_run), ("finite", strained_run))}
change = abs(relative["linear"] - relative["finite"]).max() / abs(relative["finite"]).max()
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for name, style in (("linear", "--"), ("finite", "-")):
    for i, label in enumerate(strained_run.output_names):
        axis.plot(strained_run.times, relative[name][:, i], style, color=f"C{i}", label=f"{label}, {name}")
axis.set(xlabel="time [s]", ylabel="relative to hand [m]")
axis.legend(ncols=2)
if speak:
    print(f"the law changes the deformation by {100 * change:.0f} %; energy drift {strained_run.energy_drift:.1e}")
assert 0.02 < change < 1
assert strained_run.energy_drift < 1e-10  # the discrete gradient keeps the balance to the tolerance of Newton's method

# %% [markdown]
# A doubled move: the strain grows, and so does what linear elasticity gets wrong.

# %%
far = {"motion": {"target": [10.0, 6.0]}, **small}
a = sg.simulate(sg.build("paper_forward", **far))
b = sg.simulate(sg.build("paper_forward", effects={"finite_strain": {"law": "neo-hooke"}}, **far))
more = abs(a.outputs - b.outputs).max() / abs(b.outputs - b.outputs_rigid).max()
if speak:
    print(f"over twice the distance it changes it by {100 * more:.0f} %")
assert more > change

# %% [markdown]
# The reduced model computes the force at a few of the cells, with weights that keep its energy. It estimates its own
# error, and refuses motions outside of what trained it.

# %%
rom = sg.reduce(strained, strained_run, N=14)
answer = sg.replay(rom, strained, strained_run)
error = sg.errors(rom, answer, strained, strained_run)
if speak:
    print(f"{rom.N} columns, {rom.cells.count} of {strained.cells // 2} boxes of cells")
    print(f"error of the displacement {100 * error.z:.2f} %, its own estimate {100 * answer.error_estimate:.2f} %")
assert error.z < 0.05
assert answer.energy_drift < 1e-8
rom

# %%
assert np.ptp(answer.energy) > 0  # energies over time, as in `answer.to_xarray()`
answer.plot()
