"""Meshes, clouds and grids for the tests."""

from __future__ import annotations

import numpy as np


def bumpy_sphere(rings: int, radius: float, waves: float) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface of about 4 rings^2 triangles, not convex with waves: vertices and triangles."""
    polar, around = np.linspace(0.0, np.pi, rings + 1)[1:-1], np.linspace(0.0, 2.0 * np.pi, 2 * rings + 1)[:-1]
    theta, phi = (x.ravel() for x in np.meshgrid(polar, around, indexing="ij"))
    far = radius * (1.0 + waves * np.sin(3.0 * phi) * np.sin(theta) ** 2)
    ring = far[:, None] * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    vertices = np.concatenate([ring, [[0.0, 0.0, radius], [0.0, 0.0, -radius]]])
    columns, top, bottom, faces = 2 * rings, len(ring), len(ring) + 1, []
    for j in range(columns):
        k = (j + 1) % columns
        faces += [(top, j, k), (bottom, (rings - 2) * columns + k, (rings - 2) * columns + j)]
        for i in range(rings - 2):
            a, b = i * columns + j, i * columns + k
            faces += [(a, a + columns, b + columns), (a, b + columns, b)]
    return vertices, np.array(faces)
