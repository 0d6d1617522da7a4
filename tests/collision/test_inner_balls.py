"""Balls inside of solids, against Coal's own tests of the solids."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
from support import STEP

from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.inner_balls import inner_balls
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import MeshFile, Obstacle


def test_balls_inside_of_solids_are_inside(robot: Robot, baxter: Robot, tmp_path: Path) -> None:
    (tmp_path / "step.obj").write_text(STEP)
    held_step = Obstacle(name="step", mesh=MeshFile(file=str(tmp_path / "step.obj")))
    shapes = [item.geometry for some in (robot, baxter) for item in some.geometry.geometryObjects]
    request, there, found = coal.CollisionRequest(), coal.Transform3s.Identity(), 0
    for shape in [*shapes, coal_geometry(held_step)]:
        balls = inner_balls(shape)
        found += len(balls)
        shell = isinstance(shape, coal.BVHModelBase)
        for x, y, z, radius in balls:
            place = coal.Transform3s(np.eye(3), np.array([x, y, z]))
            if shell:  # the surface is outside of the ball, and the ball inside of the surface
                ball = coal.Sphere(0.999 * radius)
                assert not coal.collide(shape, there, ball, place, request, coal.CollisionResult())
                assert EnclosingMesh.of(shape).contains(np.array([x, y, z]))
            else:
                turns = np.random.default_rng(0).normal(size=(50, 3))
                for turn in turns / np.linalg.norm(turns, axis=1)[:, None]:
                    dot = coal.Transform3s(np.eye(3), np.array([x, y, z]) + 0.999 * radius * turn)
                    assert coal.collide(shape, there, coal.Sphere(1e-6), dot, request, coal.CollisionResult())
    assert found > 3 * len(shapes)
