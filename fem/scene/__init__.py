"""What a scene says: its sections, its file, and the materials that ship."""
