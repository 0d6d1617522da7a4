"""Depth images: voxels looked up in them; triangles drawn as such, registration and fits of surfaces to depth."""
