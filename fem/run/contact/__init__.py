"""Contact of a run with obstacles: what a step does, the start at rest, and what is recorded."""
