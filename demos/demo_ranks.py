# %% [markdown]
# # Do more ranks, or a restart, change the result?
# The same scene on one rank and on two, and a run that stops half-way and goes on. Run it with
# `python demos/demo_ranks.py`, or under `mpiexec -n 2`.

# %%
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.errors import Paused
from softgrasp.fem.run.simulate import RunOptions

comm = MPI.COMM_WORLD
folder = Path(comm.bcast(mkdtemp() if comm.rank == 0 else None))
model = sg.build("paper_forward", tissue={"cells": [20, 40]}, time={"steps": 300})
whole = sg.simulate(model)
whole

# %% [markdown]
# The run stops after step 120 and writes a restart file, as it does on Ctrl-C or on SIGTERM of a cluster's queue.

# %%
try:
    sg.simulate(model, RunOptions(folder, until=120))
except Paused as stop:
    if comm.rank == 0:
        print(str(stop).replace(str(folder), "FOLDER"))

# %% [markdown]
# It goes on from there, and ends bitwise where the whole run ends: states, outputs, energy.

# %%
rest = sg.simulate(model, RunOptions(folder, resume=True))
assert np.array_equal(rest.outputs, whole.outputs)
assert np.array_equal(rest.final, whole.final)
assert np.array_equal(rest.energy, whole.energy)
if comm.rank == 0:
    print("outputs, states and energy are the same bits;", rest.steps_timed, "steps were left")

# %% [markdown]
# On two ranks the mesh is shared, and a sum has another order: the results differ by rounding. Commands start as
# `mpiexec -n 2 softgrasp simulate paper_forward`; the `mpiexec` is that of the environment.

# %%
SCRIPT = """
import numpy as np, softgrasp as sg
run = sg.simulate(sg.build("paper_forward", tissue={"cells": [20, 40]}, time={"steps": 300}))
from mpi4py import MPI
if MPI.COMM_WORLD.rank == 0:
    np.save("two.npy", run.outputs)
"""
if comm.size == 1:  # under mpiexec the ranks are there already
    launcher = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or "mpiexec"
    subprocess.run([launcher, "-n", "2", sys.executable, "-c", SCRIPT], cwd=folder, check=True)
    two = np.load(folder / "two.npy")
    difference = np.abs(two - whole.outputs).max() / np.abs(whole.outputs).max()
    print(f"two ranks against one: {difference:.1e} of the largest output")
    assert difference < 1e-10  # rounding, grown over 300 steps

# %%
comm.Barrier()
if comm.rank == 0:
    shutil.rmtree(folder)
whole.plot()
