"""``softgrasp query``: what a certified model answers, with its error."""
