"""Motions over time: cubic pieces, jerk profiles and time parameterization."""
