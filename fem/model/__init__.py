"""From a scene to the matrices of hand and tissue."""
