"""The midpoint run: step, motion of the hand, snapshots, restart."""
