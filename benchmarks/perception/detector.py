"""Objects found by the learned detector on synthetic frames, alone and with the fit: errors, covariances, and time.

Scenes are states of the suites' robot with an object in each hand and 3 to 6 others that stand or lie on its tables,
seen from 1 to 1.5 m, 640 x 480 pixels, with random light, textures and clutter. The network was trained on other
seeds and never on frames of MuJoCo. Errors of depths, camera and grasps are those of ``benchmarks.perception.held``.
Objects whose center is outside the image do not count. An object is found where a detection of its kind is within
6 cm; "false" is the number of other detections in a frame. Of a ball errors are those of its center; axes of boxes,
cans and pegs have no sign. "grasp x3": what is reported of grasps is three times as wrong, and the fit expects it.
"squared" is the mean of normalized squared errors over the dimensions that a detection has (5; of a ball 3), "within"
the share of objects within the 95 % ellipsoid. In brackets: each seed. Times are CPU times of a frame, on one core.

Usage: python -m benchmarks.perception.detector [-n 150] [--seeds 21 22]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from tqdm import tqdm

from apex_ompl.perception.detection_fit import DetectionFit, nearest, with_detection
from apex_ompl.perception.detector import OPEN, DetectedObject, ObjectDetector
from apex_ompl.perception.detector_scenes import ObjectScene, ObjectSceneGenerator, SceneObject, matched
from apex_ompl.perception.held import HeldObject, HeldObjectFinder
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.held_shapes import Expected
from apex_ompl.perception.registration import RegistrationSettings, corrected
from apex_ompl.perception.rendering import Mujoco, Renderer, ZBuffer
from apex_ompl.perception.surfaces import RobotSurface
from apex_ompl.perception.synthetic import GRASP_SHIFT, GRASP_TURN, KINDS, held_object
from apex_ompl.problems.objects import DATA
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, pose_fields
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.process import one_torch_thread
from benchmarks.lib import record
from benchmarks.perception.held import table

DEPENDS = (
    "apex_ompl/perception/detector.py", "apex_ompl/perception/detector_network.py",
    "apex_ompl/perception/detection_fit.py", "apex_ompl/perception/detector_scenes.py",
    "apex_ompl/perception/checkpoints/detector", "apex_ompl/perception/held.py",
    "apex_ompl/perception/held_fit.py", "apex_ompl/perception/held_pixels.py",
    "apex_ompl/perception/held_settings.py", "apex_ompl/perception/held_shapes.py",
    "apex_ompl/perception/registration.py", "apex_ompl/perception/rendering.py", "apex_ompl/perception/surfaces.py",
    "apex_ompl/perception/synthetic.py", "apex_ompl/perception/camera.py", "apex_ompl/kernel/compiled/perception",
    "apex_ompl/kernel/perception.py",
)  # fmt: skip
SEEDS = (21, 22)
SEEN = 0.85
SIZES = 0.1  # standard deviation of logarithms of sizes that are not known
WRONG = (1, 3)  # factors of errors of grasps
CHI_SQUARED = {3: 7.815, 5: 11.070}  # 95 %


@dataclass(frozen=True)
class Sample:
    """An object of a scene, found or not by a method.

    Attributes:
        scene: Number of the scene.
        method: The method.
        kind: Kind of the object.
        held: Whether a hand holds it.
        seen: Share of its outline that is not hidden.
        found: Whether there is an answer.
        center: Error of the center [m].
        axis: Error of the axis [degrees], NaN for a ball.
        squared: Normalized squared error of a detection, else NaN.
        spent: CPU time of the frame [s].
    """

    scene: int
    method: str
    kind: str
    held: bool
    seen: float
    found: bool
    center: float
    axis: float
    squared: float
    spent: float


def axis_error(one: SceneObject, axis: Array) -> float:
    """Return the error of an axis [degrees], NaN for a ball."""
    if one.kind == "ball":
        return float("nan")
    cosine = float(axis @ one.pose[:3, 2])
    return float(np.degrees(np.arccos(np.clip(cosine if one.kind in OPEN else abs(cosine), -1.0, 1.0))))


def squared_error(one: SceneObject, found: DetectedObject) -> float:
    """Return the normalized squared error of a detection, of its center and of its axis."""
    off = one.pose[:3, 3] - found.center
    total = float(off @ np.linalg.solve(found.covariance[3:, 3:], off))
    if one.kind == "ball":
        return total
    turn = np.linalg.eigvalsh(found.covariance[:3, :3])[0]
    return total + float(np.radians(axis_error(one, found.axis)) ** 2 / turn)


def sample(
    scene: int, method: str, one: SceneObject, found: DetectedObject | HeldObject | None, spent: float
) -> Sample:
    """Return what a method says of an object."""
    center, axis, squared = np.full(3, np.nan), np.full(3, np.nan), np.nan
    answered = found is not None and not (isinstance(found, HeldObject) and found.reason)
    if isinstance(found, DetectedObject):
        center, axis, squared = found.center, found.axis, squared_error(one, found)
    elif found is not None and answered:
        center, axis = found.pose[:3, 3], found.pose[:3, 2]
    error = float(np.linalg.norm(center - one.pose[:3, 3]))
    return Sample(
        scene, method, one.kind, one.held, one.seen, answered, error, axis_error(one, axis), float(squared), spent
    )


def worse(reported: AttachedObject, rng: np.random.Generator, factor: float) -> AttachedObject:
    """Return an object with a grasp whose error has a factor."""
    if factor <= 1.0:
        return reported
    more = float(np.sqrt(factor**2 - 1.0))
    pose = reported.pose
    pose[:3, :3] = pin.rpy.rpyToMatrix(np.radians(rng.normal(0.0, more * np.array(GRASP_TURN)))) @ pose[:3, :3]
    pose[:3, 3] += rng.normal(0.0, more * np.array(GRASP_SHIFT))
    return reported.model_copy(update=pose_fields(pose))


def held_settings(factor: float) -> HeldSettings:
    """Return settings of a fit that expects errors of grasps with a factor."""
    shift, turn = (tuple(factor * value for value in values) for values in (GRASP_SHIFT, GRASP_TURN))
    return HeldSettings(grasp_shift=shift, grasp_turn=turn)


class Methods:
    """What is compared."""

    def __init__(self, made: Robot, detector: ObjectDetector) -> None:
        """Take the robot and the detector."""
        self.robot, self.detector = made, detector
        palm = made.hands[sorted(made.hands)[0]].palm
        bodies = {kind: held_object(kind, one.size, palm, -1, name=kind, meshes=DATA) for kind, one in KINDS.items()}
        self._fit = DetectionFit(made, bodies, settings=HeldSettings(size_spread=SIZES))
        self._surface = RobotSurface(made)
        self.false = 0

    def samples(self, k: int, scene: ObjectScene, rng: np.random.Generator) -> list[Sample]:
        """Return all objects of a scene by all methods."""
        chosen = [one for one in scene.objects if one.inside]
        started = time.process_time()
        found = self.detector.find(scene.frame)
        spent = time.process_time() - started
        owners = matched(scene.objects, [one.center for one in found])
        mine: dict[int, DetectedObject] = {}
        for one, owner in zip(found, owners, strict=True):
            if owner is None or scene.objects[owner].kind != one.kind:
                self.false += 1
            else:
                mine[scene.objects[owner].label] = one
        samples = [sample(k, "detector", one, mine.get(one.label), spent) for one in chosen]
        started = time.process_time()
        seen = corrected(scene.frame, self._surface, RegistrationSettings())
        labels, free = [one.label for one in chosen if not one.held and one.label in mine], {}
        if labels:
            free = dict(zip(labels, self._fit.refine_in(seen, [mine[label] for label in labels]), strict=True))
        spent += time.process_time() - started
        samples += [sample(k, "detector + fit", one, free.get(one.label), spent) for one in chosen if not one.held]
        for factor in WRONG:
            samples += self._held(k, scene, found, factor, rng)
        return samples

    def _held(
        self, k: int, scene: ObjectScene, found: Sequence[DetectedObject], factor: float, rng: np.random.Generator
    ) -> list[Sample]:  # fmt: skip
        """Return the objects of the hands, found from their grasps, from detections, and from both."""
        finder = HeldObjectFinder(
            self.robot, [worse(one, rng, factor) for one in scene.reported], held_settings(factor)
        )
        started = time.process_time()
        seen = corrected(scene.frame, self._surface, RegistrationSettings())
        expected = finder.expected(seen.registration.state)
        before = time.process_time() - started
        near = [nearest(found, one.name, one) for one in expected]
        unsure = [unknown(one) for one in expected]
        options: dict[str, list[Expected | None]] = {
            f"grasp x{factor} + fit": list(expected),
            f"grasp x{factor} and detector + fit": [
                one if it is None else with_detection(one, it) for one, it in zip(expected, near, strict=True)
            ],
        }
        if factor == WRONG[-1]:
            options["detector + fit, held"] = [
                None if it is None else with_detection(one, it) for one, it in zip(unsure, near, strict=True)
            ]
        samples = []
        for method, starts in options.items():
            started = time.process_time()
            answers = iter(finder.find_expected(seen, [one for one in starts if one is not None]))
            mine = [None if one is None else next(answers) for one in starts]
            spent = before + time.process_time() - started
            samples += [
                sample(k, method, one, it, spent) for one, it in zip(scene.objects, mine, strict=False) if one.inside
            ]
        return samples


def unknown(one: Expected) -> Expected:
    """Return what is expected of an object of whose place and axis nothing is known."""
    return one._replace(covariance=np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]))


def _both(values: dict[int, Array], p: float, factor: float = 1.0) -> str:
    total = np.concatenate(list(values.values()))
    each = ", ".join(f"{factor * record.percentiles(one, p)[0]:.1f}" for one in values.values())
    return f"{factor * record.percentiles(total, p)[0]:.1f} ({each})"


def errors_row(label: str, chosen: dict[int, list[Sample]], frames: int) -> list[Any]:
    """Return the cells of a row of errors of some samples by seed."""
    found = {seed: [one for one in mine if one.found] for seed, mine in chosen.items()}
    center = {seed: np.array([one.center for one in mine]) for seed, mine in found.items()}
    axis = {seed: np.array([one.axis for one in mine if np.isfinite(one.axis)]) for seed, mine in found.items()}
    count, total = sum(map(len, found.values())), sum(map(len, chosen.values()))
    spent = [1e3 * t for t in {(s, one.scene): one.spent for s, mine in chosen.items() for one in mine}.values()]
    return [
        label, frames, total, f"{count / max(total, 1):.2f}", _both(center, 50, 1e3), _both(center, 95, 1e3),
        _both(axis, 50), _both(axis, 95), *(f"{v:.1f}" for v in record.percentiles(spent, 50, 95)),
    ]  # fmt: skip


HEAD = (
    "method", "frames", "objects", "found", "center p50 mm", "center p95 mm", "axis p50 deg", "axis p95 deg", "ms p50",
    "ms p95",
)  # fmt: skip
SQUARED = (
    "method, free", "kind", "objects", "found", "center p50 mm", "center p95 mm", "axis p50 deg", "axis p95 deg",
    "squared", "within",
)  # fmt: skip


def errors_rows(renderer: str, drawn: dict[int, list[Sample]], n: int) -> list[list[Any]]:
    """Return the rows of errors of a renderer."""
    rows, frames = [], n * len(drawn)
    methods = list(dict.fromkeys(one.method for mine in drawn.values() for one in mine))
    for method in methods:
        for held in (False, True):
            mine = {
                s: [one for one in found if one.method == method and one.held == held] for s, found in drawn.items()
            }
            if not any(mine.values()):
                continue
            where = "" if method not in ("detector", "detector + fit") else ", held" if held else ", free"
            rows.append(errors_row(f"{method}{where}, {renderer}", mine, frames))
            wide = {s: [one for one in found if one.seen >= SEEN] for s, found in mine.items()}
            rows.append(errors_row(f"{method}{where}, 85 % seen, {renderer}", wide, frames))
    return rows


def kind_rows(found: Sequence[Sample]) -> list[list[Any]]:
    """Return the rows of free objects by kind, of those that are seen to 85 % or more."""
    rows = []
    for method in ("detector", "detector + fit"):
        for kind in sorted(KINDS):
            mine = [one for one in found if (one.method, one.kind) == (method, kind)]
            mine = [one for one in mine if one.seen >= SEEN and not one.held]
            there = [one for one in mine if one.found]
            n = 3 if kind == "ball" else 5
            squared = np.array([one.squared for one in there])
            center = record.percentiles([1e3 * one.center for one in there], 50, 95)
            axis = record.percentiles([one.axis for one in there], 50, 95)
            own = [f"{squared.mean() / n:.2f}", f"{np.mean(squared < CHI_SQUARED[n]):.3f}"]
            rows.append(
                [method, kind, len(mine), f"{len(there) / max(len(mine), 1):.2f}", *(f"{v:.1f}" for v in center),
                 *("" if kind == "ball" else f"{v:.1f}" for v in axis), *(own if method == "detector" else ("", ""))]
            )  # fmt: skip
    return rows


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__ or "", 150, "scenes of a seed and a renderer")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS), help="(default: %(default)s)")
    parser.add_argument("--detector", help="folder of a checkpoint (default: the one that ships)")
    given, made = parser.parse_args(), robot()
    detector = ObjectDetector.load(given.detector)
    rows: list[list[Any]] = []
    found: list[Sample] = []
    false = []
    renderers: tuple[Renderer, ...] = (ZBuffer(), Mujoco())
    with one_torch_thread():
        for renderer in renderers:
            name, methods = type(renderer).__name__, Methods(made, detector)
            generator = ObjectSceneGenerator(made, DATA, renderer)
            drawn: dict[int, list[Sample]] = {}
            for seed in given.seeds:
                drawn[seed] = []
                for k in tqdm(range(given.n), desc=f"{name} {seed}"):
                    scene = generator.draw_objects(np.random.default_rng((seed, k)))
                    drawn[seed] += methods.samples(k, scene, np.random.default_rng((seed, k, 1)))
            rows += errors_rows(name, drawn, given.n)
            found += [one for mine in drawn.values() for one in mine]
            false.append([name, given.n * len(given.seeds), f"{methods.false / (given.n * len(given.seeds)):.2f}"])
    parts = [table(HEAD, rows), table(SQUARED, kind_rows(found)), table(("renderer", "frames", "false"), false)]
    data = {"rows": rows, "kinds": kind_rows(found), "false": false}
    record.write("perception_detector", data, "\n\n".join(parts), n=given.n, seeds=given.seeds)


if __name__ == "__main__":
    run_script(main)
