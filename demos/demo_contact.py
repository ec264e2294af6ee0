# %% [markdown]
# # What do a table and a disc do to the tissue that meets them?
# A hand sets a block of muscle down on a table, carries one against a disc, and drops with a block of silicone. In each
# step the obstacles push only, and only nodes that touch; at rest their forces balance weight and hand.

# %%
import numpy as np
from mpi4py import MPI

import softgrasp as sg

speak = MPI.COMM_WORLD.rank == 0
G = 9.81  # [m/s^2]
model = sg.build("set_down")
run = sg.simulate(model)
run.animate(model)

# %% [markdown]
# The table carries what the hand presses and the tissue weighs, whose density is 1060 kg/m³. No node is in the table.

# %%
run.plot_contact()

# %%
weight = 1060 * 0.06 * 0.04 * G  # of a body 1 m thick [N]
table, hand = run.contact.force_end[0, 1], run.force[-2:, 1].mean()
if speak:
    print(f"the table carries {table:.1f} N: {weight:.1f} N of weight and {-hand:.1f} N from the hand")
assert abs(table + hand - weight) < 1e-3 * table  # at rest but for a vibration
assert run.contact.penetration < 1e-12  # rounding
assert run.energy_drift < 1e-12  # the balance closes to rounding, with the work of contact in it

# %% [markdown]
# A disc presses the side of the block: few nodes touch, and the force is horizontal but for the slope of the surface.

# %%
model = sg.build("push_disc")
run = sg.simulate(model)
push, hand = run.contact.force_end[0], run.force[-2:].mean(axis=0)
if speak:
    print(f"the disc pushes by {np.linalg.norm(push):.1f} N on {run.contact.touching[-1, 0]:.0f} nodes")
assert push[0] < 0 < hand[0]
assert abs(push[0] + hand[0]) < 1e-3 * abs(push[0])
run.animate(model)

# %% [markdown]
# In space nothing holds the hand of 0.73 kg. It falls with its block, rebounds, and comes to rest by its own weight.

# %%
model = sg.build("set_down_3d")
run = sg.simulate(model)
weight = (0.73 + 1070 * 0.05 * 0.05 * 0.04) * G
table = run.contact.force_end[0, 2]
if speak:
    print(f"the table carries {table:.2f} N of {weight:.2f} N; at most {run.contact.force[:, 0, 2].max():.1f} N")
assert abs(table - weight) < 0.01 * weight
run.animate(model)

# %%
run.plot_contact()
