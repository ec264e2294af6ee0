# %% [markdown]
# # Which basis keeps the structure, and how accurate is it?
# One run of the full model, a basis from its states, and small models that repeat it: at the same material and at
# one they have not seen. Run it with `python demos/demo_reduce.py`, or under `mpiexec -n 2`.

# %%
from dataclasses import replace

from mpi4py import MPI

import softgrasp as sg

speak = MPI.COMM_WORLD.rank == 0
model = sg.build("paper_forward")
run = sg.simulate(model)

# %% [markdown]
# Errors are those of the deformation: what the tissue does besides following the hand. The rigid translation to
# (5, 3) would hide them. N counts all columns of V, the hand's included.

# %%
off = {}
for method in ("psd", "psd_svd_like", "craig_bampton"):
    rom = sg.reduce(model, run, method, N=14)
    error = sg.errors(rom, sg.replay(rom, model, run), model, run)
    off[method] = error.error_deformation
    if speak:
        stable = rom.at().stable
        print(
            f"{method:14s} stable {stable}, error of the deformation {100 * error.error_deformation:.2g} %, "
            f"of the state {100 * error.error:.2g} %"
        )
assert off["craig_bampton"] < 0.01 < off["psd"]  # PSD in the plain product spends its columns on the translation

# %% [markdown]
# The model is affine in the material, so another stiffness needs small matrices only. Its error there needs a full
# run to measure: undamped vibrations of slightly wrong frequency drift out of phase.

# %%
rom = sg.reduce(model, run, "craig_bampton", N=30)
stiff = model.with_materials(lam=100.0)
here = sg.errors(rom, sg.replay(rom, model, run), model, run).error_deformation
there = sg.errors(rom, sg.replay(rom, stiff, run), stiff, sg.simulate(stiff)).error_deformation
if speak:
    print(f"N = 30: error of the deformation {here:.1e} where it was trained, {there:.1e} at twice the lambda")
assert here < 2e-3  # a thousandth of the deformation
assert here < there < 0.15  # the shapes of lambda = mu do not span those of lambda = 2 mu

# %% [markdown]
# A query needs no mesh: the model lies in one file, and another material needs small matrices only. `softgrasp query`
# asks a model that also proves a bound of its error (guide: certified models).

# %%
if speak:
    sg.save(replace(rom, reconstruction=None), "out/rom.h5")  # without the way back to the mesh
    online = sg.load("out/rom.h5")
    for mu in (40.0, 50.0, 60.0):
        small = online.at(tuple(replace(m, mu=mu) for m in online.materials))
        slowest = abs(small.spectrum.eigenvalues).min()
        print(f"mu = {mu:.0f} Pa: stable {small.stable}, lowest frequency {slowest:.3f} rad/s")
        assert small.stable

# %%
rom.plot_errors(model, run)
