# %% [markdown]
# # Is a basis of one's own better than the paper's?
# A file gives displacements of the tissue; softgrasp makes a model of them and compares it with its own. The
# file here, `demos/static_responses.py`, takes what the tissue does under slow motions of the hand.
# Run it with `python demos/demo_own_basis.py`, or under `mpiexec -n 2`.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
from mpi4py import MPI

import softgrasp as sg
from softgrasp.reduction.bases.plugins import load_plugins

speak = MPI.COMM_WORLD.rank == 0
model = sg.build("paper_forward")
run = sg.simulate(model)

# %% [markdown]
# `K^-1 G` is the tissue under a constant acceleration of the hand, `K^-1 M K^-1 G` corrects it for slow changes, and so
# on: the moments of the transfer function at zero frequency. They need no snapshots, only solves with one factor.

# %%
PLUGIN = Path(sg.PACKAGE).resolve().parent / "demos" / "static_responses.py"
load_plugins([PLUGIN])

# %% [markdown]
# The same number of columns for all, the hand's four included.

# %%
METHODS = ("static_responses", "craig_bampton", "psd_fixed", "psd_svd_like", "componentwise_pod", "psd")
SIZES, error, stable = (14, 22, 30), {}, {}
for method in METHODS:
    for N in SIZES:
        rom = sg.reduce(model, run, method, N=N)
        stable[method, N] = rom.at().stable
        small = sg.replay(rom, model, run) if stable[method, N] else None
        error[method, N] = sg.errors(rom, small, model, run).error_deformation if small else float("nan")
if speak:
    print(f"{'basis':18s}" + "".join(f"{f'N = {N}':>10s}" for N in SIZES))
    for method in METHODS:
        cells = (f"{100 * error[method, N]:.2f} %" if stable[method, N] else "unstable" for N in SIZES)
        print(f"{method:18s}" + "".join(f"{cell:>10s}" for cell in cells))
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for method in METHODS:
    line = axis.semilogy(SIZES, [error[method, N] for N in SIZES], "o-", label=method)
axis.set(xlabel="N", ylabel="error of the deformation [1]", xticks=SIZES)
axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

# %% [markdown]
# It is good, and not the best: 1.5 % of the deformation at N = 14, as componentwise POD has, and stable at every N
# since M and K stay symmetric and definite, which POD is not. Craig-Bampton and the SVD-like basis are better; PSD with
# the hand kept apart, and in the plain product, are far behind.

# %%
assert error["static_responses", 14] < 0.02
assert error["craig_bampton", 14] < error["static_responses", 14] < error["psd_fixed", 14] / 4
assert all(stable["static_responses", N] for N in SIZES)

# %% [markdown]
# On the command line a scene names the file, and `reduce` adds the basis to its tables, figures and models:
#
#     softgrasp reduce paper_forward -s "reduction.plugins=['static_responses.py']"
#
# The path counts from the folder of the scene.

# %%
best = sg.reduce(model, run, "static_responses", N=22)
best.plot_errors(model, run)
