"""Paths made to graze: their least distance by Coal, pair by pair, against what the full check proves.

A state on the border of contact is found by bisection, with the pair that touches there. A straight path is laid
through it along the tangent of that pair's distance, shifted along the gradient by 1 um to 1 mm to either side. What is
true of it is computed without the project's kernel: the least distance of the pair along the path by Coal's GJK and its
trees of triangles, refined by golden section, and the collisions of all pairs at 200 states.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.mesh_stage import MeshStage
from apex_ompl.collision.solids import transform
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, MeshFile, Obstacle

TRAY = ((-0.2, 0), (0.2, 0), (0.2, 0.15), (0.17, 0.15), (0.17, 0.03), (-0.17, 0.03), (-0.17, 0.15), (-0.2, 0.15))
TRAY_CAP = ((0, 1, 4), (0, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 7), (5, 6, 7))
SHIFTS = (1e-6, 1e-3)  # [m]
SAMPLES = 200
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
EXACT = 1e-9  # of Coal's distances [m]


def write_tray(path: Path) -> None:
    """Write a tray 40 cm wide with walls 3 cm thick, a closed mesh that is not convex, as OBJ."""
    corners = [(x, y, z) for y in (-0.15, 0.15) for x, z in TRAY]
    n = len(TRAY)
    faces = [f for i in range(n) for f in ((i, (i + 1) % n, n + (i + 1) % n), (i, n + (i + 1) % n, n + i))]
    faces += [(c, b, a) for a, b, c in TRAY_CAP] + [(n + a, n + b, n + c) for a, b, c in TRAY_CAP]
    lines = [f"v {x} {y} {z}\n" for x, y, z in corners] + [f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces]
    path.write_text("".join(lines))


def obstacles(rng: np.random.Generator, tray: Path) -> list[Obstacle]:
    """Return obstacles of each kind, turned at random."""

    def spot() -> dict[str, tuple[float, ...]]:
        turn = rng.normal(size=4)
        place = rng.uniform([0.25, -0.6, 0.15], [0.8, 0.6, 0.9])
        return {"position": tuple(place), "orientation": tuple(turn / np.linalg.norm(turn))}

    return [
        *(Obstacle(name=f"box_{k}", box=tuple(rng.uniform(0.03, 0.25, 3)), **spot()) for k in range(3)),
        Obstacle(name="can", cylinder={"radius": 0.06, "length": 0.2}, **spot()),
        Obstacle(name="disc", cylinder={"radius": 0.1, "length": 0.02}, **spot()),
        Obstacle(name="pill", capsule={"radius": 0.04, "length": 0.3}, **spot()),
        Obstacle(name="ball", sphere={"radius": 0.06}, **spot()),
        Obstacle(name="ceiling", half_space={"normal": (0.0, 0.1, -1.0), "offset": -1.3}),
        Obstacle(name="tray", mesh=MeshFile(file=str(tray)), **spot()),
    ]


def held_objects(robot: Robot, tray: Path) -> list[AttachedObject]:
    """Return a cup in one hand and a tray in the other."""
    palms = [hand.palm for hand in robot.hands.values()]
    return [
        AttachedObject(name="cup", link=palms[0], cylinder={"radius": 0.035, "length": 0.12}, position=(0, 0, 0.1)),
        AttachedObject(name="held_tray", link=palms[1], mesh=MeshFile(file=str(tray), scale=(0.5, 0.5, 0.5)),
                       position=(0, 0, 0.15)),
    ]  # fmt: skip


class PairDistances:
    """Distances of single pairs by Pinocchio's kinematics and Coal, without the kernel."""

    def __init__(self, checker: CollisionChecker) -> None:
        """Take the geometries of a checker."""
        self.scene = checker.meshes
        self.robot = checker.robot
        self.data = self.robot.model.createData()
        for solid in self.scene.solids.values():
            solid.shape.computeLocalAABB()

    def __call__(self, q: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
        """Return the distances of pairs of geometries at a state, shape (pairs,) [m]."""
        self._place(q)
        return np.array([self._distance(*pair) for pair in pairs])

    def nearest(self, q: np.ndarray) -> tuple[float, tuple[int, int]]:
        """Return the least distance of all pairs at a state [m], and its pair.

        Pairs are taken by the gaps of the balls that Coal puts around them, which are at most the distances.
        """
        self._place(q)
        balls = {}
        for k, solid in self.scene.solids.items():
            balls[k] = self._pose(k).act(solid.shape.aabb_center), solid.shape.aabb_radius
        pairs, least, nearest = self.scene.pairs, np.inf, (-1, -1)
        gaps = np.array([np.linalg.norm(balls[a][0] - balls[b][0]) - balls[a][1] - balls[b][1] for a, b in pairs])
        gaps[np.isnan(gaps)] = -np.inf  # of half-spaces, whose balls are infinite
        for k in np.argsort(gaps):
            if gaps[k] > least:
                break
            value = self._distance(*pairs[k])
            least, nearest = (value, pairs[k]) if value < least else (least, nearest)
        return least, nearest

    def _place(self, q: np.ndarray) -> None:
        pin.forwardKinematics(self.robot.model, self.data, self.robot.to_pinocchio(q))

    def _pose(self, number: int) -> pin.SE3:
        solid = self.scene.solids[number]
        return self.data.oMi[solid.joint] * solid.placement

    def _distance(self, a: int, b: int) -> float:
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        request.gjk_tolerance, request.gjk_max_iterations = EXACT, 1000
        sides = (part for k in (a, b) for part in (self.scene.solids[k].shape, transform(self._pose(k))))
        return float(coal.distance(*sides, request, result))

    def least_along(self, a: np.ndarray, b: np.ndarray, pair: tuple[int, int]) -> float:
        """Return the least distance of a pair on a straight path: 200 states, then golden section [m]."""
        at = np.linspace(0.0, 1.0, SAMPLES)
        values = [float(self(a + u * (b - a), [pair])[0]) for u in at]
        k = int(np.argmin(values))
        low, high = at[max(k - 1, 0)], at[min(k + 1, SAMPLES - 1)]
        least = values[k]
        for _ in range(40):
            m, n = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
            p, q = (float(self(a + u * (b - a), [pair])[0]) for u in (m, n))
            low, high = (low, n) if p < q else (m, high)
            least = min(least, p, q)
        return least


class Graze(NamedTuple):
    """Ends of a straight path, each of shape (dof,), and the pair of geometries that it grazes with."""

    first: np.ndarray
    last: np.ndarray
    pair: tuple[int, int]


@dataclass
class Grazes:
    """Numbers of grazing paths.

    Attributes:
        paths: Paths tried.
        colliding: Those that collide, by Coal.
        false_free: Of these, those that were proved free; it must be 0.
        clear: Paths that stay more than 20 um clear.
        refused: Of these, those that were not proved; it must be 0.
        off: Proved paths on which a pair comes nearer than the clearance proved; it must be 0.
        pairs: Kinds of pairs that grazed, and how often.
    """

    paths: int = 0
    colliding: int = 0
    false_free: int = 0
    clear: int = 0
    refused: int = 0
    off: int = 0
    pairs: dict[str, int] = field(default_factory=dict)

    def add(self, other: Grazes) -> None:
        """Add the numbers of others."""
        for name, value in vars(other).items():
            if name != "pairs":
                setattr(self, name, getattr(self, name) + value)
        for name, times in other.pairs.items():
            self.pairs[name] = self.pairs.get(name, 0) + times

    def try_path(
        self, both: CollisionChecker, meshes: CollisionChecker, distances: PairDistances, graze: Graze
    ) -> None:
        """Compare the proof of a straight path with what is true of it."""
        a, b, pair = graze
        least = distances.least_along(a, b, pair)
        free = bool(meshes.are_free(a + np.linspace(0.0, 1.0, SAMPLES)[:, None] * (b - a)).all())
        proof = both.prove(np.stack([a, b]))
        self.paths += 1
        if not free or least <= 0.0:
            self.colliding += 1
            self.false_free += bool(proof)
            return
        if proof:
            self.off += least < proof.clearance_bound - 1e-7
        elif (
            least > 2e-5 and proof.clearance > 0.0 and set(proof.pair) == {distances.scene.solids[k].name for k in pair}
        ):
            self.refused += 1
        self.clear += least > 2e-5


def _kind(scene: MeshStage, pair: tuple[int, int]) -> str:
    """Return the kinds of two geometries: a link, or the first word of an object's name."""
    names = []
    for k in pair:
        label = scene.solids[k].name
        of_robot = k < scene.links
        names.append("link" if of_robot else label.split("_")[0])
    return " and ".join(sorted(names))


def grazing_paths(robot: Robot, rng: np.random.Generator, wanted: int, folder: Path, per_scene: int = 40) -> Grazes:
    """Try paths that graze, of random pairs, half of them with held objects."""
    tray, count, k = folder / "tray.obj", Grazes(), 0
    write_tray(tray)
    while count.paths < wanted:
        k += 1
        scene, held = obstacles(rng, tray), held_objects(robot, tray) if k % 2 else []
        both, meshes = CollisionChecker(robot, scene, held), CollisionChecker(robot, scene, held, proofs=False)
        distances = PairDistances(both)
        states = np.clip(robot.home + rng.normal(0.0, 0.4, (300, robot.dof)), robot.limits.lower, robot.limits.upper)
        free = both.are_free(states)
        outside, inside = states[free], states[~free]
        tried = min(per_scene, len(outside), len(inside), wanted - count.paths)
        for a, b in zip(rng.permutation(outside)[:tried], rng.permutation(inside)[:tried], strict=True):
            graze = lay_graze(meshes, distances, rng, a, b)
            if graze is not None:
                name = _kind(distances.scene, graze.pair)
                count.pairs[name] = count.pairs.get(name, 0) + 1
                count.try_path(both, meshes, distances, graze)
    return count


def lay_graze(
    meshes: CollisionChecker, distances: PairDistances, rng: np.random.Generator, a: np.ndarray, b: np.ndarray
) -> Graze | None:
    """Return a path through the border of contact between a free state ``a`` and a colliding one ``b``, shifted."""
    low, high, robot = 0.0, 1.0, meshes.robot
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if meshes.is_free(a + middle * (b - a)) else (low, middle)
    state = a + low * (b - a)
    least, pair = distances.nearest(state)
    if least > 1e-5:  # a solid inside of another
        return None
    step = 1e-6 * np.eye(robot.dof)
    outer = a + (low - 1e-3) * (b - a)  # a little clear of the contact, where distances are smooth
    slope = np.array([distances(outer + e, [pair])[0] - distances(outer - e, [pair])[0] for e in step]) / 2e-6
    norm = float(np.linalg.norm(slope))
    if norm < 1e-3:
        return None
    tangent = rng.normal(size=robot.dof) * (rng.random(robot.dof) < rng.uniform(0.2, 1.0))
    tangent -= slope * (slope @ tangent) / norm**2
    if not np.linalg.norm(tangent) > 1e-6:
        return None
    tangent *= rng.uniform(0.005, 0.2) / float(np.linalg.norm(tangent))
    shift = float(np.exp(rng.uniform(*np.log(SHIFTS)))) * rng.choice([-1.0, 1.0])
    middle = state + slope / norm**2 * shift
    ends = middle - tangent, middle + tangent
    return None if any(robot.limit_fault(q) for q in ends) else Graze(*ends, pair)
