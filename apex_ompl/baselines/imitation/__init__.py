"""Imitation learning: a transformer policy that is trained on stored paths, a baseline of the paper."""
