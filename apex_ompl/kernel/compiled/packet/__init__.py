"""Arithmetic on several numbers at once: sines, products of vectors and of matrices."""
