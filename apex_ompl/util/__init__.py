"""Files, argument checks, provenance, threads, and other things without geometry."""
