"""Collision checks of states, motions and curves: clearances with gradients, and proofs."""
