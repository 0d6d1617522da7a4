"""Sphere covers: made offline, and proved to contain their solids."""
