"""Motions among dynamic obstacles: proofs in time, blocked intervals, speeds along a path, stops and optimization."""
