"""The scene: its sections, its file, and the library of materials."""
