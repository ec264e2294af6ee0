# %% [markdown]
# # What happens to a soft strip that is turned upside down?
# A hand lifts a strip of silicone and turns it by half a turn. Equations of small rotations would stretch it by the
# turn; here they are those of the hand's own axes, in which gravity turns and the turn loads the tissue.

# %%
import numpy as np
from mpi4py import MPI

import softgrasp as sg

speak = MPI.COMM_WORLD.rank == 0
small = ["tissue.cells=[6, 12]", "tissue.order=1", "time.steps=150"]
model = sg.build("turn_over", small)
run = sg.simulate(model)
run.plot()

# %% [markdown]
# The strip hangs at the start and stands at the end: in the axes of the hand the tip is then pressed towards it.

# %%
z = run.outputs - run.outputs_rigid  # of the tip, in space
if speak:
    print(f"the hand ends at {np.degrees(run.q_s[-1, 2]):.1f} degrees; the tip sags by {-1e3 * z[-1, 1]:.2f} mm")
assert abs(run.q_s[-1, 2] - np.pi) < 1e-12
assert z[0, 1] < 0  # downwards while it hangs
assert z[-1, 1] < 0  # and while it stands
assert run.energy_drift < 1e-10  # the balance closes to rounding over the loads of the frame too

# %% [markdown]
# The linear law in the frame serves where the strain is small, however large the turn. It has a reduced model, which
# has the loads of the turn from d² numbers a mode and d² a pair of modes.

# %%
linear = sg.build("turn_over", [*small, "effects.finite_strain=false"])
led = sg.simulate(linear)
apart = np.abs(led.outputs - run.outputs).max() / np.abs(z).max()
rom = sg.reduce(linear, led, "craig_bampton", N=26)
error = sg.errors(rom, sg.replay(rom, linear, led), linear, led).z
if speak:
    print(f"the linear law differs by {100 * apart:.1f} % of the deformation")
    print(f"{rom.k} modes differ by {100 * error:.1f} % from the linear run")
assert 1e-3 < apart < 0.05
assert error < 0.05
rom

# %% [markdown]
# The film of the run at finite strain.

# %%
run.animate(model)
