"""Data sets of verified paths: records, store, generation by the kernel alone, statistics."""
