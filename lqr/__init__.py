"""Linear-quadratic regulator: Lyapunov and Riccati solvers, feedback; imports reduction, never DOLFINx."""
