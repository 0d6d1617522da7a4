"""Constraints along a path, the frames that they are about, and what is fixed to the links of a robot."""
