"""All that numba compiles; the cache of compiled code is named after a digest of the files in this folder."""
