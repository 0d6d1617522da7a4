"""Pictures: rendered scenes, films, plots."""
