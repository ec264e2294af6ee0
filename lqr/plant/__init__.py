"""The optimal control problem: plant, weights, gain, coordinates."""
