"""``softgrasp identify``: the material from measured outputs."""
