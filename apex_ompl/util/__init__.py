"""Files, argument checks, provenance, threads and other utilities."""
