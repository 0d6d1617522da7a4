"""Planning problems and their files: bodies, meshes, start and goal."""
