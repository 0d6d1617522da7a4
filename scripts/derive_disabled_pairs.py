"""Derive the link pairs of a robot that need no collision check, and write them to its pairs file.

The pairs considered are those that no SRDF lists and whose links stand on the same root part (a hand
against itself and its own arm), never one arm against the other. Three findings disable a pair:

- ``by design``: both links belong to a part named with ``--soft``, a hand whose fingers touch each other
  and the palm as its single synergy closes; the synergy of first contact in a sweep is stated.
- ``always``: in collision at every sample.
- ``never``: free at every sample, and still at least ``--margin`` apart at the closest state that a local
  search from the closest samples finds; that distance is stated.

Usage: python scripts/derive_disabled_pairs.py dual_panda_softhand --soft left_hand --soft right_hand
       python scripts/derive_disabled_pairs.py my.robot.yaml    (name the file as ``disabled_pairs`` in it then)
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pinocchio as pin

from apex_ompl.collision.hulls import convex_hull
from apex_ompl.errors import UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.robot.config import PAIRS_SCHEMA, RobotConfig
from apex_ompl.robot.geometry import link_of
from apex_ompl.robot.model import bare_robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.schema import yaml_value
from apex_ompl.util.validation import one_or_more, whole_number


def root_part(robot: Robot, config: RobotConfig, link: str) -> str:
    """Return the part at the root of the chain of parts that carries ``link``."""
    part = next(p for p in config.parts if p.name == robot.part_of(link))
    return part.name if part.parent == "world" else root_part(robot, config, part.parent)


def candidates(robot: Robot, config: RobotConfig) -> list[tuple[int, int]]:
    """Return the geometry index pairs to test: enabled ones whose parts have the same root part."""
    items = robot.geometry.geometryObjects
    chosen = []
    for pair in robot.geometry.collisionPairs:
        a, b = items[pair.first], items[pair.second]
        roots = [root_part(robot, config, link_of(robot.model, item)) for item in (a, b)]
        if roots[0] == roots[1]:
            chosen.append((pair.first, pair.second))
    return chosen


class PairModel:
    """Collision and signed distance of chosen pairs at any state, with meshes and with convex hulls."""

    def __init__(self, robot: Robot, pairs: list[tuple[int, int]]) -> None:
        """Keep copies of the geometry restricted to ``pairs``."""
        self.robot = robot
        self.data = robot.model.createData()
        self.meshes, self.hulls = robot.geometry.copy(), robot.geometry.copy()
        for model in (self.meshes, self.hulls):
            model.removeAllCollisionPairs()
            for pair in pairs:
                model.addCollisionPair(pin.CollisionPair(*pair))
        for item in self.hulls.geometryObjects:
            item.geometry = convex_hull(item.geometry)
        self.mesh_data, self.hull_data = self.meshes.createData(), self.hulls.createData()

    def colliding(self, q: np.ndarray) -> np.ndarray:
        """Return which pairs collide by the meshes, shape (pairs,)."""
        q = self.robot.to_pinocchio(q)
        pin.computeCollisions(self.robot.model, self.data, self.meshes, self.mesh_data, q, False)
        return np.array([r.isCollision() for r in self.mesh_data.collisionResults], bool)

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the signed distances of all pairs between convex hulls, shape (pairs,) [m]."""
        q = self.robot.to_pinocchio(q)
        pin.computeDistances(self.robot.model, self.data, self.hulls, self.hull_data, q)
        return np.array([r.min_distance for r in self.hull_data.distanceResults], float)


def sweep_soft(robot: Robot, pairs: list[tuple[int, int]]) -> list[str]:
    """Return the reason for each pair inside a soft hand, from a sweep of all synergies at once."""
    model = PairModel(robot, pairs)
    hands = [k for k, name in enumerate(robot.joint_names) if "synergy" in name]
    first = np.full(len(pairs), np.nan)
    for s in np.linspace(0.0, 1.0, 1001):
        q = robot.home.copy()
        q[hands] = s
        first[np.isnan(first) & model.colliding(q)] = s
    return ["never in a sweep of the synergy" if np.isnan(s) else f"by design, from synergy {s:.3f}" for s in first]


def derive(
    robot: Robot, pairs: list[tuple[int, int]], *, samples: int, margin: float, seed: int
) -> dict[tuple[int, int], str]:
    """Return pair -> reason for the pairs that always or never collide."""
    from scipy.optimize import minimize

    rng = np.random.default_rng(seed)
    model = PairModel(robot, pairs)
    hits = sum(model.colliding(q).astype(int) for q in robot.random_state(rng, 500))
    reasons = {pair: "always in 500 samples" for pair, n in zip(pairs, hits, strict=True) if n == 500}
    left = [pair for pair, n in zip(pairs, hits, strict=True) if n == 0]
    done = 500
    while done < samples and left:
        model = PairModel(robot, left)
        chunk = robot.random_state(rng, min(5000, samples - done))
        hit = np.zeros(len(left), bool)
        for q in chunk:
            hit |= model.colliding(q)
        left = [pair for pair, h in zip(left, hit, strict=True) if not h]
        done += len(chunk)
        print(f"{done} samples: {len(left)} pairs never hit", flush=True)
    states = robot.random_state(rng, 4000)
    model = PairModel(robot, left)
    table = np.array([model.distances(q) for q in states])
    low, high = robot.limits.lower, robot.limits.upper
    for k, pair in enumerate(left):
        single = PairModel(robot, [pair])
        closest = np.inf
        for q in states[np.argsort(table[:, k])[:4]]:
            found = minimize(
                lambda x, m=single: float(m.distances(np.clip(x, low, high))[0]), q, method="Powell",
                bounds=list(zip(low, high, strict=True)), options={"maxfev": 4000, "xtol": 1e-3},
            )  # fmt: skip
            closest = min(closest, float(found.fun))
        names = [link_of(robot.model, robot.geometry.geometryObjects[i]) for i in pair]
        print(f"{names[0]} {names[1]}: closest {closest * 1e3:.1f} mm", flush=True)
        if closest >= margin:
            reasons[pair] = f"never in {samples} samples, closest found {closest * 1e3:.0f} mm"
    return reasons


def as_yaml(name: str) -> str:
    """Return a name as YAML reads it, in quotes where it would be a number or a truth value without them."""
    return name if yaml_value(name) == name else json.dumps(name)


def main() -> None:
    """Derive and write the pairs of one robot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", help="name of a shipped robot, or a robot file")
    parser.add_argument("--soft", action="append", default=[], metavar="PART")
    parser.add_argument("--samples", type=one_or_more, default=200_000)
    parser.add_argument("--margin", type=float, default=0.02, help="least distance of a pair [m]")
    parser.add_argument("--seed", type=whole_number, default=0)
    args = parser.parse_args()
    robot, config, path = bare_robot(args.robot)
    unknown = sorted({*args.soft} - {*robot.part_links})
    if unknown:
        raise UnknownNameError("part", unknown[0], robot.part_links)
    items = robot.geometry.geometryObjects
    pairs = candidates(robot, config)
    parts = {p: tuple(robot.part_of(link_of(robot.model, items[i])) for i in p) for p in pairs}
    soft = [p for p in pairs if parts[p][0] == parts[p][1] and parts[p][0] in args.soft]
    reasons = dict(zip(soft, sweep_soft(robot, soft), strict=True))
    rest = [p for p in pairs if p not in reasons]
    reasons |= derive(robot, rest, samples=args.samples, margin=args.margin, seed=args.seed)
    rows = []
    for pair in pairs:
        if pair in reasons:
            links = sorted(link_of(robot.model, items[i]) for i in pair)
            rows.append({"links": links, "reason": reasons[pair]})
    rows.sort(key=lambda row: row["links"])
    lines = [f"schema: {PAIRS_SCHEMA}", f"# made by scripts/derive_disabled_pairs.py, seed {args.seed}", "pairs:"]
    lines += [f'  - {{links: [{", ".join(map(as_yaml, r["links"]))}], reason: "{r["reason"]}"}}' for r in rows]
    target = path.parent / (config.disabled_pairs or f"{path.name.split('.')[0]}.pairs.yaml")
    write_atomically(Path(target), ("\n".join(lines) + "\n").encode())
    print(f"{len(rows)} of {len(pairs)} pairs disabled -> {target}")


if __name__ == "__main__":
    run_script(main, "bench")
