"""Fields on the mesh: series of files and what pictures show."""
