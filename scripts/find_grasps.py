"""Search in physics for poses in which a hand holds the objects of the ready-made problems by friction.

A hand of its own is simulated (:mod:`apex_ompl.drivers`), whose fingers yield. It closes on an object that a soft weld
guides, which is then cut. Gravity is that which the object feels in the palm along motions that are planned for the
problem: R^T (g - a), with the orientation R of the palm and the acceleration a of the object. A pose is kept where the
object moves by less than 5 mm from it, with friction and mass 20 % less and more, and with the object 5 mm off at
first. Candidates are random around the pose of the problem, then around the best ones. The result is a table, one
line a candidate, which a later run continues.

Usage: python scripts/find_grasps.py [PROBLEM ...] --count 2000 --out grasps
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from apex_ompl import plan, problems
from apex_ompl.collision.mass import per_mass
from apex_ompl.collision.shapes import coal_geometry, is_shell
from apex_ompl.drivers import Twin, TwinSettings
from apex_ompl.drivers.twin_settings import with_mass
from apex_ompl.errors import SceneError
from apex_ompl.goals.grasp import grasp
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.config import DATA
from apex_ompl.scene.bodies import AttachedObject, MeshFile, pose_fields, pose_matrix
from apex_ompl.scene.meshes import triangles
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script

READY = ("stack_boxes", "ball_in_cup", "peg_in_hole", "pour", "handover", "pack_bin", "pour_upright")
GRAVITY = np.array([0.0, 0.0, -9.81])
STIFFNESS = 0.3  # of the fingers [Nm/rad]
CLOSING, SETTLING = 0.5, 0.3  # in which a hand closes, and an object settles [s]
GUIDE = (0.02, 1.0)  # time constant and damping of the weld that guides an object
RATE = 50.0  # of gravity along a motion [1/s]
FAR = 0.012  # distance from the pose at which a candidate is given up [m]
HELD, TURNED = 0.005, 0.1  # most distance and angle of an object that is held [m, rad]
OFF = 0.005  # of an object at first [m]
GAP = 0.0005  # between palm and object [m]
SHARE = 0.5  # of candidates that are around the best ones
SQUEEZE = 0.8  # of synergies beyond first contact
ROBUST = [(0.8, 1.2), (0.8, 0.8), (1.2, 1.2)]  # factors of friction and mass


@dataclass(frozen=True)
class Candidate:
    """A pose in the frame of the palm and how it holds.

    Attributes:
        position: Position [m].
        orientation: Quaternion xyzw.
        synergy: Just before first contact.
        moved: Largest distance from the pose [m]; that of the worst case where it held.
        turned: Largest angle from it [rad].
        robust: Number of cases held.
    """

    position: tuple[float, ...]
    orientation: tuple[float, ...]
    synergy: float
    moved: float
    turned: float
    robust: int


@cache
def hand_robot(side: str) -> Robot:
    """Return a robot that is a hand of the suites' robot."""
    hand = robot().hands[f"{side}_hand"]
    record = {
        "schema": "apex-ompl/robot/1", "name": f"{side}_softhand",
        "parts": [{"name": f"{side}_hand", "urdf": str(DATA / f"softhand2_{side}.urdf"), "prefix": f"{side}_hand_"}],
        "joints": {str(hand.synergy): {"home": 0.0, "velocity": 1.5, "acceleration": 10.0, "jerk": 200.0}},
        "hands": {f"{side}_hand": hand.model_dump(mode="json")},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hand.robot.yaml"
        file.write_text(json.dumps(record))  # JSON is YAML
        return load_robot(str(file))


def felt_gravity(problem: Problem, held: AttachedObject, seed: int) -> Array:
    """Return the gravity that an object feels in the frame of its palm along a planned motion, shape (N, 3) [m/s^2]."""
    motion = plan(problem, timeout=60.0, seed=seed).trajectory
    if motion is None:
        raise RuntimeError(f"{problem.name} was not solved")
    times = np.arange(0.0, motion.duration, 1.0 / RATE)
    poses = np.array([robot().link_pose(q, held.link) for q in motion(times)])
    centers = (poses @ held.pose)[:, :3, 3]
    acceleration = np.zeros_like(centers)
    acceleration[1:-1] = np.diff(centers, 2, axis=0) * RATE**2
    return np.einsum("nji,nj->ni", poses[:, :3, :3], GRAVITY - acceleration)


def outside(held: AttachedObject) -> AttachedObject:
    """Return an object with the convex hull of its mesh, which fingers touch, and with its own mass."""
    mesh = coal_geometry(held)
    if held.mesh is None or not is_shell(mesh):
        return held.model_copy(update={"contact": None})
    center, inertia = per_mass(held)
    heavy = with_mass(held, TwinSettings().density)
    assert heavy.mass is not None
    hull = trimesh.convex.convex_hull(triangles(mesh)[0])
    file = Path(tempfile.mkdtemp()) / "hull.obj"
    hull.export(file)
    moments = heavy.mass * inertia[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return heavy.model_copy(
        update={
            "contact": None, "mesh": MeshFile(file=str(file)), "center_of_mass": tuple(center.tolist()),
            "inertia": tuple(moments.tolist()),
        }
    )  # fmt: skip


class Search:
    """Candidates for an object of a problem.

    Attributes:
        held: The object as the problem has it.
        hand: Name of its hand.
    """

    def __init__(self, problem: Problem, held: AttachedObject, seeds: tuple[int, ...] = (1, 2)) -> None:
        """Plan motions of the problem, and build a model of the hand with the object."""
        self.held, self.hand = held, next(n for n, h in robot().hands.items() if h.palm == held.link)
        self.robot = hand_robot(self.hand.split("_")[0])
        self.synergy = str(self.robot.hands[self.hand].synergy)
        own = outside(held)
        start = {self.synergy: 0.0}
        pairs = tuple(combinations(self.robot.link_names[1:], 2))
        alone = Problem(
            name="hand", robot="hand", attached=(own,), allowed=pairs, start=start, goal=Goal(joints=(start,))
        )  # fmt: skip
        self.twin = Twin(self.robot, alone, TwinSettings(finger_stiffness=STIFFNESS))
        self.data = self.twin.data(np.zeros(1))
        self.palm = self.robot.link_pose(np.zeros(1), held.link)
        self.gravities = [felt_gravity(problem, held, seed) for seed in seeds]
        model = self.twin.model
        self.weld = model.equality(f"{held.name} {held.link}").id
        self.body = model.body(held.name).id
        self.mass, self.friction = float(model.body_mass[self.body]), model.geom_friction.copy()
        self.inertia = model.body_inertia[self.body].copy()

    def draw(self, rng: np.random.Generator, best: list[Candidate]) -> Array:
        """Return a random pose: around one of the best candidates, or around the problem's pose."""
        if best and rng.random() < SHARE:
            one = best[int(rng.integers(len(best)))]
            pose = pose_matrix(one.position, one.orientation)
            pose[:3, 3] += rng.normal(0.0, 0.004, 3)
            pose[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.08, 3)).as_matrix() @ pose[:3, :3]
            return pose
        pose = self.held.pose.copy()
        pose[:3, 3] += rng.uniform((-0.05, -0.09, -0.03), (0.05, 0.05, 0.02))
        tilt = rng.normal(0.0, 0.3, 3)
        pose[:3, :3] = Rotation.from_rotvec(tilt).as_matrix() @ pose[:3, :3]
        return pose

    def off_palm(self, pose: Array) -> Array | None:
        """Return a pose without contact with the open hand, along the normal of the palm; None if there is none."""
        for _ in range(40):
            self._place(pose, 0.0)
            depth = max((self.twin.contacts(self.data) or {("", ""): 0.0}).values())
            if depth <= 0.0:
                return pose
            pose = pose.copy()
            pose[2, 3] -= depth + GAP
        return None

    def _place(self, pose: Array, synergy: float) -> None:
        self.twin.place(self.data, np.array([synergy]))
        self.twin._set_free(self.data, self.held.name, self.palm @ pose)
        self.twin._mj.mj_forward(self.twin.model, self.data)

    def first_contact(self, pose: Array) -> float | None:
        """Return the synergy just before first contact, or None."""
        try:
            found = grasp(robot(), self.hand, self.held.model_copy(update=pose_fields(pose)))
        except SceneError:
            return None
        return found.synergy if found.touched else None

    def held_by(
        self, pose: Array, synergy: float, gravity: Array, factors: tuple[float, float] = (1.0, 1.0),
        at: Array | None = None,
    ) -> tuple[float, float, Array]:  # fmt: skip
        """Close the hand on the object, let go, and follow a motion.

        Returns:
            Largest distance [m] and angle [rad] from the first pose, and the pose in which it settled.
        """
        twin, data, model = self.twin, self.data, self.twin.model
        first = pose if at is None else at
        model.geom_friction[:] = self.friction * np.array([factors[0], 1.0, 1.0])
        model.body_mass[self.body] = self.mass * factors[1]
        model.body_inertia[self.body] = self.inertia * factors[1]
        self._place(first, max(0.0, synergy - 0.1))
        twin.weld(data, self.held.name, self.held.link)
        stiff = model.eq_solref[self.weld].copy(), model.eq_solimp[self.weld].copy()
        model.eq_solref[self.weld], model.eq_solimp[self.weld, :2] = GUIDE, (0.9, 0.95)
        model.opt.gravity[:] = 0.0
        dt = twin.settings.step
        target = min(1.0, synergy + SQUEEZE)
        begin = float(data.qpos[twin.q[0]])
        steps = round(CLOSING / dt)
        for k in range(steps):
            self._step(begin + (target - begin) * min(1.0, 1.25 * (k + 1) / steps))
        model.eq_solref[self.weld], model.eq_solimp[self.weld] = stiff
        data.eq_active[self.weld] = False
        moved = turned = 0.0
        settled = first
        for k in range(round(SETTLING * RATE) + len(gravity)):
            row = max(0, k - round(SETTLING * RATE))
            model.opt.gravity[:] = self.palm[:3, :3] @ gravity[row]
            for _ in range(round(1.0 / RATE / dt)):
                self._step(target)
            now = np.linalg.inv(self.palm) @ twin.pose(data, self.held.name)
            if row == 0:
                settled = now
            moved = max(moved, float(np.linalg.norm(now[:3, 3] - first[:3, 3])))
            turned = max(turned, float(Rotation.from_matrix(now[:3, :3] @ first[:3, :3].T).magnitude()))
            if moved > FAR or turned > 4.0 * TURNED or not np.isfinite(moved):
                return np.inf, np.inf, settled
        return moved, turned, settled

    def _step(self, target: float) -> None:
        twin, data = self.twin, self.data
        data.ctrl[twin.u] = twin.kp * (target - data.qpos[twin.q]) - twin.kd * data.qvel[twin.v]
        twin.step(data)

    def judged(self, rng: np.random.Generator, best: list[Candidate]) -> Candidate | None:
        """Return a random candidate with how it holds, or None where it does not."""
        clear = self.off_palm(self.draw(rng, best))
        synergy = None if clear is None else self.first_contact(clear)
        if clear is None or synergy is None:
            return None
        pose = clear
        moved, turned, settled = self.held_by(pose, synergy, self.gravities[0])
        if not np.isfinite(moved):
            return None
        better = self.off_palm(settled)
        again = None if better is None else self.first_contact(better)
        if better is not None and again is not None and moved > 0.001:
            other = self.held_by(better, again, self.gravities[0])
            if other[0] < moved:
                pose, synergy, (moved, turned, _) = better, again, other
        held = 0
        if moved <= HELD and turned <= TURNED:
            for gravity in self.gravities:
                for factors in ROBUST:
                    offset = pose.copy()
                    away = rng.normal(0.0, 1.0, 3)
                    offset[:3, 3] += OFF * rng.random() ** (1 / 3) * away / np.linalg.norm(away)
                    shifted = self.off_palm(offset)
                    if shifted is None:
                        continue
                    other = self.held_by(pose, synergy, gravity, factors, shifted)
                    held += other[0] <= HELD and other[1] <= TURNED
        fields = pose_fields(pose)
        return Candidate(
            tuple(np.round(fields["position"], 5).tolist()), tuple(np.round(fields["orientation"], 6).tolist()),
            round(synergy, 4), round(moved, 5), round(turned, 4), held,
        )  # fmt: skip


def searched(problem: Problem, held: AttachedObject, count: int, folder: Path, seed: int) -> list[Candidate]:
    """Continue the search for an object until it has had a number of candidates, and return what held."""
    file = folder / f"{problem.name}.{held.name}.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    found = [Candidate(**{k: v for k, v in row.items() if k != "number"}) for row in rows if "moved" in row]
    begin = rows[-1]["number"] + 1 if rows else 0
    if begin >= count:
        return ranked(found)
    search = Search(problem, held)
    with file.open("a") as out:
        for number in tqdm(range(begin, count), desc=f"{problem.name} {held.name}", mininterval=10.0):
            rng = np.random.default_rng([seed, number])
            one = search.judged(rng, ranked(found)[:8])
            if one is not None:
                found.append(one)
            if one is not None or number == count - 1:
                out.write(json.dumps({"number": number, **(asdict(one) if one else {})}) + "\n")
                out.flush()
    return ranked(found)


def ranked(found: list[Candidate]) -> list[Candidate]:
    """Return candidates, the best first."""
    return sorted(found, key=lambda one: (-one.robust, one.moved))


def objects(names: list[str]) -> Iterator[tuple[Problem, AttachedObject]]:
    """Yield the objects of problems that one hand holds."""
    for name in names:
        problem = problems.load(name)
        yield from ((problem, held) for held in problem.attached if len(held.holders) == 1)


def main() -> None:
    """Search, and print the best candidates."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("problems", nargs="*", default=list(READY))
    parser.add_argument("--count", type=int, default=2000, help="candidates for each object (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("grasps"), help="folder of tables (default: %(default)s)")
    parser.add_argument("--object", action="append", default=[], help="only these objects")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for problem, held in objects(given.problems):
        if given.object and held.name not in given.object:
            continue
        best: list[Any] = searched(problem, held, given.count, given.out, given.seed)
        print(f"{problem.name} {held.name}: {len(best)} of {given.count} held")
        for one in best[:3]:
            print(f"    {one}")


if __name__ == "__main__":
    run_script(main)
