"""`softgrasp study`: what accuracy costs in time."""
