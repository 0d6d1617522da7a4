"""Generation of training data: units of work, their problems, and the solving of those with meshes."""
