"""Training data made from drawn problems."""
