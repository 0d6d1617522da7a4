"""The functions that numba compiles, by subject.

The cache of compiled code is named after a digest of all files in this folder. Only :mod:`apex_ompl.kernel` imports
from here: its modules wrap the functions for the other packages.
"""
