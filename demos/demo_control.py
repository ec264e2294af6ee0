# %% [markdown]
# # Which feedback moves the hand best, and how does the loop answer?
# The Riccati equation of the whole plant, the closed loop under its gain, and the small controller that a robot runs.
# Run it with `python demos/demo_control.py`, or under `mpiexec -n 2`.

# %%
import numpy as np
from mpi4py import MPI

import softgrasp as sg
from softgrasp.lqr.loop.margins import loop_margins

speak = MPI.COMM_WORLD.rank == 0
model = sg.build("paper_lqr", ["tissue.cells=[6, 12]"])
problem = sg.problem(model)
solution = sg.solve(problem)

# %% [markdown]
# `E'XA + A'XE - E'XB R^-1 B'XE + C'QC = 0` with the true residual, and a certificate that the loop is stable.

# %%
abscissa = sg.abscissa(problem, solution.gain)
if speak:
    print(f"residual {solution.residual:.1e}, rank {solution.rank}, abscissa {abscissa.value:.4f} 1/s")
assert solution.residual < 1e-8
assert abscissa.value < 0

# %% [markdown]
# The full plant under this gain goes to (5, 3).

# %%
loop = sg.ClosedLoop(problem, dt=0.5)
move = loop.run(solution.gain, target=[5.0, 3.0], steps=600)
if speak:
    print("hand at the end", move.q_s[-1], "cost", move.cost[-1])
assert abs(move.q_s[-1] - [5, 3]).max() < 1e-2  # 300 s are about five time constants of the slowest pole
move.plot()

# %% [markdown]
# A robot measures its hand only. The controller carries a few numbers of the tissue itself; one tick is some
# microseconds of NumPy.

# %%
controller = sg.make_controller(sg.design(model), order=8)
force = controller.towards(np.array([5.0, 3.0])).step(np.zeros(2), np.zeros(2))
if speak:
    print("first force on the hand", force)
assert force @ [5.0, 3.0] > 0  # it pulls towards the target

# %% [markdown]
# Bode diagram of the loop, opened at each input, with the controller's tissue model in it: gain, phase, margins.

# %%
margins = loop_margins(controller)
if speak:
    print(margins)
margins.plot()

# %% [markdown]
# Your own loop: each millisecond measure the hand, ask the controller, apply the force. Here a free hand stands
# for the robot.

# %%
robot = controller.towards(np.array([5.0, 3.0]))
robot.reset()
q, v, mass = np.zeros(2), np.zeros(2), model.system.M_hand[0, 0]
for _ in range(60_000):  # one minute
    u = robot.step(q, v)
    q, v = q + robot.period * v + robot.period**2 / 2 * u / mass, v + robot.period * u / mass
if speak:
    print("hand after a minute", q)
assert abs(q - [5, 3]).max() < 0.01  # twenty seconds of the crossover at 0.35 rad/s are enough; the tissue is slower
