"""The observer of ``softgrasp control``: what it finds, its part of the page."""
