"""Many runs: list and compare them, sweep a key of a scene, begin a scene of one's own."""
