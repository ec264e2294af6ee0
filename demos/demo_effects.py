# %% [markdown]
# # What does an effect cost, and what does it change?
# Every effect is off unless the scene names it. This demo switches two on, one after the other, and looks at what they
# add and at what they change.

# %%
import numpy as np
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate

comm = MPI.COMM_WORLD
plain = build("paper_forward", comm=comm)
heavy = build("paper_forward", ["effects.gravity.g=[0.0,-1.0]"], comm=comm)

# %% [markdown]
# Gravity reuses the coupling `G` of the moving hand, so it adds no form and no operator; it still changes the motion.

# %%
assert heavy.inventory.forms == plain.inventory.forms
assert heavy.inventory.operators == plain.inventory.operators
a, b = simulate(plain), simulate(heavy)
if comm.rank == 0:
    print(f"gravity moves the tip by up to {np.abs(a.outputs - b.outputs).max():.3g} m and needs no operator")
assert np.abs(a.outputs - b.outputs).max() > 1e-3

# %% [markdown]
# Kelvin-Voigt damping `D = beta K` needs no matrix of its own either; it damps the vibration of the tissue.

# %%
longer = ["time.end=6.0", "time.steps=1200"]  # the hand rests from t = 3 s on
viscous = ["effects.damping.kind='kelvin-voigt'", "effects.damping.beta=0.2"]
free = simulate(build("paper_forward", longer, comm=comm))
damped = simulate(build("paper_forward", longer + viscous, comm=comm))
swing, calm = (np.ptp((r.outputs - r.outputs_rigid)[-200:], axis=0).max() for r in (free, damped))
if comm.rank == 0:
    print(f"swing of the tip in the last second: {swing:.3g} m undamped, {calm:.3g} m damped")
assert calm < swing / 5
damped.plot()
