"""Depth images: pixels in blocks, voxels looked up in them."""
