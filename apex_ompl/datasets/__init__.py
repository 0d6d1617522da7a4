"""Data sets of proven paths: records, store, engine, description."""
