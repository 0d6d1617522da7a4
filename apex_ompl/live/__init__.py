"""Obstacles that move."""
