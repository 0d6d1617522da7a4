"""Problem files: bodies, meshes, planning problems."""
