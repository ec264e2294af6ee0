"""The frame of the hand: rotations, integrals of its inertia loads, momenta of hand and tissue."""
