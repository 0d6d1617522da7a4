"""Compiled functions of perception: triangles drawn as depth images, registration and fits of surfaces to depth."""
