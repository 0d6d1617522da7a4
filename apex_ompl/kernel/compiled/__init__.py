"""All that numba compiles, by subject; the cache of compiled code is named after a digest of the files in this folder.

Only :mod:`apex_ompl.kernel` imports from here: its modules wrap the functions for the other packages.
"""
