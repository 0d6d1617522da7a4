"""Red obstacles found by color and depth on synthetic frames: errors of place and size, covariances, and time.

Scenes are those of ``benchmarks.perception.held`` with a red cube, box or cylinder of 6 to 30 cm before the robot, half
of them upright, the others turned at random, and with two in five of the things on the tables red as well. The obstacle
that is found nearest to the true one counts, within 25 cm. Obstacles seen to less than 60 % or cut by the image do not
count. "size" is the largest error of a length. Boxes are "sides seen" where the sides beside the largest one have 15 %
of the pixels that show the box or more, and "front alone" otherwise, where little or nothing tells a depth. "kept" is
the share of those that call their place known to 10 mm (one standard deviation), and the next two columns are theirs.
"squared" is the mean of normalized squared errors of the place over its 3 dimensions with its 95 % band by chi-squared,
"median" their median over that of chi-squared, "within" the share within the 95 % ellipsoid. In the last row the finder
knows the lengths of the obstacle to 1 mm. Half of the frames are by each renderer, with seeds of their own. Times are
CPU times of a frame with all its red things, without the correction of the camera, on one core.

Usage: python -m benchmarks.perception.obstacles [-n 100]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import permutations
from typing import Any, Literal

import coal
import numpy as np
from tqdm import tqdm

from apex_ompl.kernel.perception import draw_triangles
from apex_ompl.perception.obstacles import ObstacleFinder, SeenObstacle
from apex_ompl.perception.registration import RegistrationSettings, corrected
from apex_ompl.perception.rendering import Mujoco, Renderer, ZBuffer, lens_of
from apex_ompl.perception.solid_fit import KnownSize
from apex_ompl.perception.surfaces import RobotSurface, inverse
from apex_ompl.perception.synthetic import (
    OBSTACLE,
    SceneGenerator,
    SyntheticScene,
    SyntheticSettings,
    TrueObstacle,
    solid_part,
)
from apex_ompl.problems.objects import DATA
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = (
    "apex_ompl/perception/obstacles.py", "apex_ompl/perception/color_parts.py", "apex_ompl/perception/solid_fit.py",
    "apex_ompl/perception/solid_starts.py", "apex_ompl/perception/solid_pixels.py",
    "apex_ompl/perception/obstacle_settings.py",
    "apex_ompl/perception/registration.py", "apex_ompl/perception/rendering.py", "apex_ompl/perception/surfaces.py",
    "apex_ompl/perception/synthetic.py", "apex_ompl/perception/camera.py",
    "apex_ompl/kernel/compiled/perception", "apex_ompl/kernel/perception.py",
)  # fmt: skip
KINDS: tuple[Literal["cube", "box", "cylinder"], ...] = ("cube", "box", "cylinder")
SEEDS = (21, 22)
SURE = 0.01  # standard deviation of a place that is known [m]
SIDES = 0.15  # share of pixels of sides that tell the depth of a box
NEAR = 0.25  # distance within which an obstacle is the true one [m]
SEEN = 0.6
DIMENSIONS, CHI_SQUARED, MEDIAN = 3, 7.815, 2.366  # 95 % and 50 % of three degrees of freedom
HEAD = (
    "obstacle", "frames", "missed", "kind right", "place p50 mm", "p95", "size p50 mm", "p95", "kept", "place p95",
    "size p95", "squared", "band", "median", "within", "ms p50", "p95",
)  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """An obstacle of a scene.

    Attributes:
        kind: Its kind.
        renderer: What drew the scene.
        found: Kind that was found, or empty.
        place: Error of its center [m].
        size: Largest error of a length [m].
        squared: Normalized squared error of the center.
        spread: Standard deviation of the center [m].
        spent: CPU time of the frame [s].
        sides: Share of its pixels that show other sides than the largest.
    """

    kind: str
    renderer: str
    found: str
    place: float
    size: float
    squared: float
    spread: float
    spent: float
    sides: float


def side_share(true: TrueObstacle, scene: SyntheticScene) -> float:
    """Return the share of an obstacle's visible pixels that show other sides than the one seen most."""
    solid = coal.Cylinder(true.size[0] / 2.0, true.size[2]) if true.kind == "cylinder" else coal.Box(*true.size)
    at = inverse(scene.camera) @ true.pose
    surface, camera = solid_part(solid, np.eye(4), OBSTACLE, (1.0, 0.0, 0.0)).surface, scene.frames[0].camera
    corners = surface.vertices[surface.faces]
    normals = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axis = normals.argmax(axis=1)
    if true.kind == "cylinder":
        axis[axis == 1] = 0  # around
    _, index = draw_triangles(surface.at(at).vertices, surface.faces, lens_of(camera), camera.height, camera.width)
    shown = np.bincount(axis[index[(scene.labels == OBSTACLE) & (index >= 0)]], minlength=3)
    return float(1.0 - shown.max() / max(shown.sum(), 1))


def size_error(found: SeenObstacle, true: TrueObstacle) -> float:
    """Return the largest error of a length, of the axes that are most alike [m]."""
    alike = np.abs(found.pose[:3, :3].T @ true.pose[:3, :3])
    best = max(permutations(range(3)), key=lambda order: sum(alike[k, order[k]] for k in range(3)))
    return float(np.abs(found.size - true.size[list(best)]).max())


def sample(
    true: TrueObstacle, renderer: str, answers: Sequence[SeenObstacle], spent: float, sides: float
) -> Sample | None:  # fmt: skip
    """Return the sample of the obstacle that is nearest to the true one; None where the image cuts it."""
    apart = [float(np.linalg.norm(one.pose[:3, 3] - true.pose[:3, 3])) for one in answers]
    if not apart or min(apart) > NEAR:
        return Sample(true.kind, renderer, "", np.nan, np.nan, np.nan, np.nan, spent, sides)
    best = answers[int(np.argmin(apart))]
    if best.cut:
        return None
    off = true.pose[:3, 3] - best.pose[:3, 3]
    squared = float(off @ np.linalg.solve(best.covariance[3:6, 3:6], off))
    error = size_error(best, true)
    return Sample(true.kind, renderer, best.kind, min(apart), error, squared, best.place_spread, spent, sides)


def samples(made: Robot, renderer: Renderer, seed: int, n: int) -> tuple[list[Sample], list[Sample]]:
    """Return the obstacles of ``n`` scenes for each kind that are seen well enough, and those of known size."""
    generator, finder, surface = SceneGenerator(made, DATA, renderer), ObstacleFinder(), RobotSurface(made)
    found: tuple[list[Sample], list[Sample]] = [], []
    name = type(renderer).__name__
    for k in tqdm(range(n * len(KINDS)), desc=f"{name} {seed}"):
        settings = SyntheticSettings(colors=True, obstacle=KINDS[k % len(KINDS)], reds=True)
        scene = generator.draw(np.random.default_rng((seed, k)), settings)
        frame, true = scene.frames[0], scene.obstacle
        if true is None or frame.color is None or true.seen < SEEN:
            continue
        seen = corrected(frame, surface, RegistrationSettings())
        sides = side_share(true, scene)
        known = KnownSize("cylinder" if true.kind == "cylinder" else "box", true.size)
        for kept, sizes in zip(found, ((), (known,)), strict=True):
            started = time.process_time()
            answers = finder.find(seen, frame.color, known=sizes)
            one = sample(true, name, answers, time.process_time() - started, sides)
            if one is not None:
                kept.append(one)
    return found


def row(label: str, chosen: Sequence[Sample]) -> list[Any]:
    """Return the cells of a row."""
    answered = [one for one in chosen if one.found]
    squared = np.array([one.squared for one in answered])
    sure = [one for one in answered if one.spread < SURE]
    half = 1.96 * np.sqrt(2.0 / (DIMENSIONS * max(len(answered), 1)))
    right = [(one.found == "cylinder") == (one.kind == "cylinder") for one in answered]
    return [
        label, len(chosen), len(chosen) - len(answered), f"{np.mean(right):.2f}",
        *(f"{1e3 * v:.1f}" for v in record.percentiles([one.place for one in answered], 50, 95)),
        *(f"{1e3 * v:.1f}" for v in record.percentiles([one.size for one in answered], 50, 95)),
        f"{len(sure) / max(len(answered), 1):.2f}",
        f"{1e3 * record.percentiles([one.place for one in sure], 95)[0]:.1f}",
        f"{1e3 * record.percentiles([one.size for one in sure], 95)[0]:.1f}",
        f"{squared.mean() / DIMENSIONS:.2f}", f"{1.0 - half:.2f} to {1.0 + half:.2f}",
        f"{np.median(squared) / MEDIAN:.2f}",
        f"{np.mean(squared < CHI_SQUARED):.3f}",
        *(f"{1e3 * v:.0f}" for v in record.percentiles([one.spent for one in chosen], 50, 95)),
    ]  # fmt: skip


def main() -> None:
    """Measure, and write the results."""
    given = record.parser(__doc__ or "", 100, "scenes of a kind and a renderer").parse_args()
    made, renderers = robot(), list[Renderer]((ZBuffer(), Mujoco()))
    both = [samples(made, renderer, seed, given.n) for renderer, seed in zip(renderers, SEEDS, strict=True)]
    found, sized = ([one for some in both for one in some[k]] for k in range(2))
    rows = [row(kind, [one for one in found if one.kind == kind]) for kind in KINDS]
    boxes = [one for one in found if one.kind == "box"]
    rows.insert(2, row("box, sides seen", [one for one in boxes if one.sides >= SIDES]))
    rows.insert(3, row("box, front alone", [one for one in boxes if one.sides < SIDES]))
    rows += [row(f"all, {name}", [one for one in found if one.renderer == name]) for name in ("ZBuffer", "Mujoco")]
    rows += [row("all", found), row("all, sizes known", sized)]
    lines = [record.row(list(HEAD)), record.row(["---"] * len(HEAD)), *(record.row(cells) for cells in rows)]
    data = {"rows": rows, "samples": [asdict(one) for one in found]}
    record.write("perception_obstacles", data, "\n".join(lines), n=given.n, seeds=list(SEEDS))


if __name__ == "__main__":
    run_script(main)
