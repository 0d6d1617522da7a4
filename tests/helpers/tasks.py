"""An independent check of tasks: Pinocchio's kinematics and Coal's pairs, with the bodies of each step."""

from __future__ import annotations

from collections.abc import Iterator

import coal
import numpy as np
import pinocchio as pin
import trimesh

from apex_ompl import TaskResult
from apex_ompl.planning.task_result import TaskStep
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Body, pose_matrix
from apex_ompl.types import Array


def shape_of(body: Body) -> coal.CollisionGeometry:
    """Coal's shape of a body, of a mesh by trimesh."""
    if body.box is not None:
        return coal.Box(*body.box)
    if body.sphere is not None:
        return coal.Sphere(body.sphere.radius)
    if body.cylinder is not None:
        return coal.Cylinder(body.cylinder.radius, body.cylinder.length)
    assert body.mesh is not None
    mesh = trimesh.load(body.mesh.file, force="mesh")
    made = coal.BVHModelOBBRSS()
    made.beginModel(len(mesh.faces), len(mesh.vertices))
    for corners in np.asarray(mesh.triangles, float):
        made.addTriangle(*corners)
    made.endModel()
    return made


def poses(robot: Robot, step: TaskStep, q: Array) -> dict[str, Array]:
    """Poses of all obstacles and held objects of a step in the world, by Pinocchio, shape (4, 4) each."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
    found = {one.name: pose_matrix(one.position, one.orientation) for one in step.scene}
    for one in step.attached:
        frame = data.oMf[robot.model.getFrameId(one.link)].homogeneous
        found[one.name] = frame @ pose_matrix(one.position, one.orientation)
    return found


class Checker:
    """All pairs of a step, by Pinocchio's geometry model."""

    def __init__(self, robot: Robot, step: TaskStep, allowed: frozenset[frozenset[str]]) -> None:
        self.robot, self.geometry = robot, robot.geometry.copy()
        model, names = robot.model, {}
        for k, item in enumerate(self.geometry.geometryObjects):
            names[k] = model.frames[item.parentFrame].name
        links, held, still = list(names), {}, []
        for one in step.attached:
            frame = model.frames[model.getFrameId(one.link)]
            place = frame.placement * pin.SE3(pose_matrix(one.position, one.orientation))
            k = self.geometry.addGeometryObject(
                pin.GeometryObject(one.name, frame.parentJoint, model.getFrameId(one.link), place, shape_of(one))
            )
            holders = [link for holder in (one.links or (one.link,)) for link in robot.hand_of(holder)]
            names[k], held[k] = one.name, set(holders if one.touch_links is None else one.touch_links)
        for body in (*robot.fixtures, *step.scene):
            place = pin.SE3(pose_matrix(body.position, body.orientation))
            item = pin.GeometryObject(body.name, 0, 0, place, shape_of(body))
            k = self.geometry.addGeometryObject(item)
            names[k] = body.name
            still.append(k)
        pairs = [(a, b) for a in held for b in (*links, *held, *still) if b > a or b in links]
        pairs = [(a, b) for a, b in pairs if names[b] not in held[a]]
        moving = [k for k in links if self.geometry.geometryObjects[k].parentJoint > 0]
        pairs += [(a, b) for a in moving for b in still]
        for a, b in pairs:
            if frozenset((names[a], names[b])) not in allowed:
                self.geometry.addCollisionPair(pin.CollisionPair(a, b))
        self.names, self.data, self.geometry_data = names, model.createData(), self.geometry.createData()

    def contact(self, q: Array) -> tuple[str, str] | None:
        """A pair that overlaps at a state, or None."""
        order = self.robot.to_pinocchio(q)
        if not pin.computeCollisions(self.robot.model, self.data, self.geometry, self.geometry_data, order, True):
            return None
        for pair, result in zip(self.geometry.collisionPairs, self.geometry_data.collisionResults, strict=True):
            if result.isCollision():
                return self.names[pair.first], self.names[pair.second]
        return None


def contacts(robot: Robot, result: TaskResult, spacing: float) -> Iterator[tuple[float, str, str]]:
    """Time and names of pairs that overlap at states of a task's motion, a spacing apart [s]."""
    motion = result.trajectory
    assert motion is not None
    for step in result.steps:
        allowed = frozenset(map(frozenset, step.allowed))
        checker = Checker(robot, step, allowed)
        strict = Checker(robot, step, allowed - frozenset(map(frozenset, step.leaving))) if step.leaving else checker
        count = max(2, int(np.ceil((step.end - step.start) / spacing)) + 1)
        for time in np.linspace(step.start, step.end, count).tolist():
            left = not np.isnan(step.left) and time >= step.left
            found = (strict if left else checker).contact(motion(time))
            if found is not None:
                yield time, *found
