"""Robots of random joints and spheres, and their forward kinematics."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from apex_ompl.kernel import robot_builder
from apex_ompl.kernel.arrays import FIXED, PRISMATIC, REVOLUTE
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.kernel.tables import BodySpec, JointSpec, RobotTables


def unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def pose(rng: np.random.Generator, spread: float = 0.5) -> np.ndarray:
    """A random homogeneous transformation, shape (4, 4)."""
    transform = np.eye(4)
    transform[:3, :3] = pin.exp3(unit(rng) * rng.uniform(0.0, np.pi))
    transform[:3, 3] = rng.normal(0.0, spread, 3)
    return transform


def balls(rng: np.random.Generator, leaves: int) -> dict[str, np.ndarray]:
    """A tree of spheres as covers have them: leaves, and a root that contains them."""
    centers, radii = rng.normal(0.0, 0.05, (leaves, 3)), rng.uniform(0.01, 0.06, leaves)
    root = float((np.linalg.norm(centers, axis=1) + radii).max())
    return {
        "centers": np.concatenate([np.zeros((1, 3)), centers]), "radii": np.array([root, *radii]),
        "first": np.array([1] + [0] * leaves), "count": np.array([leaves] + [0] * leaves),
    }  # fmt: skip


def random_robot(seed: int, joints: int = 9, dof: int = 4) -> tuple[RobotTables, list, list, list]:
    """Tables, joints, bodies and pairs of a random tree of revolute, prismatic, fixed and mimic joints."""
    rng = np.random.default_rng(seed)
    specs = [JointSpec(0)]
    for k in range(1, joints):
        kind = int(rng.choice([REVOLUTE, REVOLUTE, PRISMATIC, FIXED]))
        specs.append(
            JointSpec(
                int(rng.integers(0, k)), kind, pose(rng, 0.2), unit(rng), -1 if kind == FIXED else k % dof,
                float(rng.uniform(-1.5, 1.5)), float(rng.normal(0.0, 0.3)),
            )
        )  # fmt: skip
    bodies = [BodySpec(f"b{k}", k, pose(rng, 0.05), **balls(rng, 3)) for k in range(joints)]
    pairs = [(a, b) for a in range(joints) for b in range(a) if rng.random() < 0.5]
    names = [f"q{k}" for k in range(dof)]
    box = np.ones(dof)
    tables = robot_builder.robot_tables(
        "tree", names, lower=-box, upper=box, tree=JointTree(specs), bodies=bodies, pairs=pairs
    )
    return tables, specs, bodies, pairs


def random_hand(seed: int) -> tuple[RobotTables, list, list, list]:
    """The same of hands: two to six fingers that follow one joint, on a wrist or fixed to the world."""
    rng = np.random.default_rng(seed)
    specs = [JointSpec(0)]
    if rng.random() < 0.7:
        specs.append(JointSpec(0, REVOLUTE, pose(rng, 0.3), unit(rng), 0, 1.0, 0.0))
    palm = len(specs) - 1
    for _ in range(int(rng.integers(2, 7))):
        parent = palm
        for _ in range(int(rng.integers(1, 4))):
            kind = int(rng.choice([REVOLUTE, REVOLUTE, REVOLUTE, PRISMATIC, FIXED]))
            ratio, shift = float(rng.uniform(-1.0, 1.5)), float(rng.normal(0.0, 0.2))
            source = -1 if kind == FIXED else 1
            specs.append(JointSpec(parent, kind, pose(rng, 0.1), unit(rng), source, ratio, shift))
            parent = len(specs) - 1
    bodies = []
    for k in range(len(specs)):
        for _ in range(int(rng.integers(1, 3))):
            meets = bool(rng.random() < 0.8)
            bodies.append(BodySpec(f"b{len(bodies)}", k, pose(rng, 0.03), meets_scene=meets, **balls(rng, 3)))
    count = len(bodies)
    pairs = [
        (a, b) for a in range(count) for b in range(a) if bodies[a].joint != bodies[b].joint and rng.random() < 0.3
    ]
    low, high = np.array([-1.0, -0.3]), np.array([1.0, 0.9])
    tables = robot_builder.robot_tables(
        "hand", ["wrist", "synergy"], lower=low, upper=high, tree=JointTree(specs), bodies=bodies, pairs=pairs
    )
    return tables, specs, bodies, pairs


def frames(specs: list, q: np.ndarray) -> list[np.ndarray]:
    """Poses of the joints in the world: T = T_parent * placement * exp(axis * value), by definition."""
    poses = [np.eye(4)]
    for joint in specs[1:]:
        motion = np.eye(4)
        value = joint.ratio * q[joint.source] + joint.shift
        if joint.kind == REVOLUTE:
            motion[:3, :3] = pin.exp3(joint.axis * value)
        elif joint.kind == PRISMATIC:
            motion[:3, 3] = joint.axis * value
        poses.append(poses[joint.parent] @ joint.placement @ motion)
    return poses
