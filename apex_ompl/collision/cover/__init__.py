"""Sphere covers of solids: search, proof and files, made offline or when a scene is compiled."""
