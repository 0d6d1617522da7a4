"""Constraints along a path: residuals, projection, path optimization, trees, and proofs."""
