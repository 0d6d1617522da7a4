"""Search, shortcuts and optimization of paths among static obstacles."""
