"""Replanners: how the closed loop finds its next motion."""
