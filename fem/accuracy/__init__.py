"""How far the outputs of a run are from those of an infinitely fine mesh, and meshes that reach a tolerance."""
