"""The part of ``softgrasp control`` about plans past obstacles."""
