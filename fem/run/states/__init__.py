"""States of a run: the trajectory, its snapshots in memory or streamed, times of frames, restart files."""
