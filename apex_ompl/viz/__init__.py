"""Rendered scenes, films and plots."""
