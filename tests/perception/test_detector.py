"""The detector of objects: its cells and rays, votes that agree, fits from detections, and checkpoints."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
from safetensors.numpy import save as save_arrays

from apex_ompl.errors import ApexError, FileFormatError, MissingFileError
from apex_ompl.perception.camera import Camera, look_at
from apex_ompl.perception.detection_fit import DetectionFit, nearest, with_detection
from apex_ompl.perception.detector import (
    FOCAL,
    KINDS,
    OPEN,
    SCHEMA,
    SHIPPED,
    SIZES,
    UNIT,
    CellVotes,
    DetectedObject,
    DetectorConfig,
    DetectorSettings,
    KindSpread,
    ObjectDetector,
    cells_of,
    grouped,
    in_cells,
    ray_frames,
    standard_view,
)
from apex_ompl.perception.detector_network import DetectorNetwork, Votes, folded, network_input
from apex_ompl.perception.detector_scenes import ObjectScene, ObjectSceneGenerator, ObjectSettings, SceneObject, matched
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.held import HeldObjectFinder
from apex_ompl.perception.synthetic import KINDS as NOMINAL
from apex_ompl.perception.synthetic import held_object
from apex_ompl.problems.objects import DATA
from apex_ompl.robot import Robot

WIDTHS = (4, 4, 4, 4, 4)


@pytest.fixture(scope="module")
def scenes(robot: Robot) -> list[ObjectScene]:
    generator = ObjectSceneGenerator(robot, DATA)
    return [generator.draw_objects(np.random.default_rng((41, k)), ObjectSettings(free=(5, 6))) for k in range(3)]


def spreads() -> dict[str, KindSpread]:
    return {kind: KindSpread(across=1.0, along=2.0, turn=1.0, size=(0.1, 0.2)) for kind in KINDS}


def test_a_cell_has_the_median_of_its_depths() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 2.0, (16, 24)) * (rng.random((16, 24)) < 0.6)
    depth[:4, :4] = 0.0
    cells = cells_of(depth)
    assert cells.depth.shape == (4, 6) and cells.depth[0, 0] == 0.0
    for i in range(4):
        for j in range(6):
            values = np.sort(depth[4 * i : 4 * i + 4, 4 * j : 4 * j + 4].ravel())
            there = values[values > 0.0]
            assert cells.depth[i, j] == (there[(len(there) - 1) // 2] if len(there) else 0.0)
    assert np.array_equal(in_cells(depth, cells.pixel), cells.depth)


def test_frames_of_rays_are_the_smallest_rotations_to_them() -> None:
    rays = np.concatenate([np.random.default_rng(1).uniform(-0.8, 0.8, (20, 2)), np.ones((20, 1))], axis=1)
    for ray, frame in zip(rays, ray_frames(rays), strict=True):
        expected = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), ray).toRotationMatrix()
        np.testing.assert_allclose(frame, expected, atol=1e-12)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.05, 0.02, 0.001, -0.002, 0.0)])
def test_a_standard_view_sees_the_same_rays(distortion: tuple[float, ...]) -> None:
    camera = Camera(width=320, height=200, focal=(300.0, 310.0), center=(150.0, 104.0), distortion=distortion)
    view = standard_view(camera)
    height, width = view.pixels.shape
    assert height % 16 == width % 16 == 0
    seen = np.argwhere(view.pixels >= 0)
    lens = FOCAL / np.array(camera.focal) * camera.center
    rays = (seen[:, ::-1] - lens) / FOCAL
    flat = view.pixels[tuple(seen.T)]
    measured = camera.rays(np.stack([flat % 320, flat // 320], axis=-1).astype(float))
    assert np.abs(rays - measured).max() < 0.6 / 300.0  # half a pixel
    assert len(seen) > 0.9 * (FOCAL / 300.0) * 320 * (FOCAL / 310.0) * 200


def votes_of(centers: list[list[float]], axes: list[np.ndarray], kinds: list[int], count: int) -> CellVotes:
    """Votes of objects, with noise of 4 mm and some that are nowhere."""
    rng, parts = np.random.default_rng(2), []
    for center, axis, kind in zip(centers, axes, kinds, strict=True):
        noisy = axis + rng.normal(0.0, 0.1, (count, 3))
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        parts.append(
            CellVotes(
                rng.integers(0, 20, (count, 2)), np.full(count, 0.95), np.eye(len(KINDS))[np.full(count, kind)],
                center + rng.normal(0.0, 0.004, (count, 3)), np.full(count, 0.004), noisy[:, :, None] * noisy[:, None],
                noisy, np.full((count, 2), 0.05),
            )
        )  # fmt: skip
    lost = 6
    parts.append(
        CellVotes(
            np.zeros((lost, 2), int), np.full(lost, 0.4), np.full((lost, 6), 1.0 / 6.0),
            rng.uniform(2.0, 3.0, (lost, 3)), np.full(lost, 0.05), np.repeat(np.eye(3)[None], lost, axis=0),
            np.ones((lost, 3)), np.zeros((lost, 2)),
        )
    )  # fmt: skip
    return CellVotes(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def test_votes_that_agree_are_objects() -> None:
    centers = [[0.1, 0.0, 1.2], [0.17, 0.0, 1.2]]
    axes = [np.array([0.0, -1.0, 0.0]), np.array([0.6, 0.0, -0.8])]
    every = grouped(votes_of(centers, axes, [KINDS.index("cup"), KINDS.index("peg")], 40), DetectorSettings())
    assert [one.score for one in every] == sorted((one.score for one in every), reverse=True)
    found = [one for one in every if one.score > 0.5]
    assert sorted(KINDS[one.kind] for one in found) == ["cup", "peg"]
    for one in found:
        k = ["cup", "peg"].index(KINDS[one.kind])
        np.testing.assert_allclose(one.center, centers[k], atol=0.002)
        cosine = one.axis @ axes[k]
        assert (cosine if k == 0 else abs(cosine)) > np.cos(np.radians(3.0))
        np.testing.assert_allclose(one.size, 0.05)
        assert one.score > 0.9 and len(one.cells) == 40


def test_few_votes_have_a_low_score_and_none_are_no_object() -> None:
    few = grouped(votes_of([[0.0, 0.0, 1.0]], [np.array([1.0, 0.0, 0.0])], [0], 1), DetectorSettings())
    many = grouped(votes_of([[0.0, 0.0, 1.0]], [np.array([1.0, 0.0, 0.0])], [0], 9), DetectorSettings())
    assert few[0].score < 0.5 and many[0].score > 0.9
    nothing = votes_of([[0.0, 0.0, 1.0]], [np.array([1.0, 0.0, 0.0])], [0], 1).of(np.zeros(0, int))
    assert grouped(nothing, DetectorSettings()) == []


class Oracle(torch.nn.Module):
    """A network that votes for the truth."""

    def __init__(self, scene: ObjectScene) -> None:
        super().__init__()
        self.scene = scene

    def forward(self, image: torch.Tensor, fine: torch.Tensor) -> Votes:
        camera, pose = self.scene.frame.camera, self.scene.frame.camera.pose
        view = standard_view(camera)
        depth = self.scene.frame.depth.ravel()[view.pixels]
        cells = cells_of(depth)
        labels = in_cells(self.scene.labels.ravel()[view.pixels], cells.pixel)
        out = {name: np.zeros((n, *labels.shape)) for name, n in zip(Votes._fields, (7, 3, 1, 6, 3, 2), strict=True)}
        out["kinds"][0] = 20.0
        out["spread"][:] = np.log(0.05)
        for one in self.scene.objects:
            center, axis = (one.pose[:3, 3] - pose[:3, 3]) @ pose[:3, :3], one.pose[:3, 2] @ pose[:3, :3]
            for i, j in np.argwhere(labels == one.label):
                column, row = 4 * j + 1.5, 4 * i + 1.5
                ray = np.array([(2 * column - 319.5) / 465.0, (2 * row - 239.5) / 465.0, 1.0])
                turn = pin.Quaternion.FromTwoVectors(ray, np.array([0.0, 0.0, 1.0])).toRotationMatrix()
                x, y, z = turn @ axis
                out["kinds"][1 + KINDS.index(one.kind), i, j] = 40.0
                out["center"][:, i, j] = turn @ (center - ray * cells.depth[i, j]) / UNIT
                out["axis"][:, i, j] = x * x, y * y, z * z, x * y, x * z, y * z
                out["sign"][:, i, j] = x, y, z
                out["size"][:, i, j] = np.log(one.size[[0, 2]] / SIZES[KINDS.index(one.kind)]) / 0.1
        return Votes(*(torch.from_numpy(out[name])[None] for name in Votes._fields))


def test_true_votes_are_true_objects(scenes: list[ObjectScene]) -> None:
    config = {
        "schema": SCHEMA,
        "kinds": KINDS,
        "widths": WIDTHS,
        "spreads": spreads(),
        "least_score": 0.4,
        "digest": "",
    }
    count = 0
    for scene in scenes:
        found = ObjectDetector(Oracle(scene), DetectorConfig.model_validate(config)).find(scene.frame)  # type: ignore[arg-type]
        owners = matched(scene.objects, [one.center for one in found])
        clear = [k for k, one in enumerate(scene.objects) if one.seen > 0.9 and one.inside]
        assert None not in owners and set(clear) <= set(owners)
        for one, owner in zip(found, owners, strict=True):
            true = scene.objects[owner]  # type: ignore[index]
            assert one.kind == true.kind
            np.testing.assert_allclose(one.center, true.pose[:3, 3], atol=1e-5)
            np.testing.assert_allclose(one.size, true.size[[0, 2]], rtol=1e-5)
            cosine = one.axis @ true.pose[:3, 2]
            assert (cosine if one.kind in OPEN else abs(cosine)) > 1.0 - 1e-6
            np.testing.assert_allclose(one.pose[:3, 2], one.axis, atol=1e-9)
            left, top, right, bottom = one.box
            rows, columns = np.nonzero(scene.labels == true.label)
            assert left - 8 <= np.median(columns) <= right + 8 and top - 8 <= np.median(rows) <= bottom + 8
            ray = true.pose[:3, 3] - scene.frame.camera.pose[:3, 3]
            values, vectors = np.linalg.eigh(one.covariance[3:, 3:])
            np.testing.assert_allclose(values, np.array([1.0, 1.0, 4.0]) * (0.05 * UNIT) ** 2, rtol=1e-4)
            assert abs(vectors[:, 2] @ ray) > 0.9999 * np.linalg.norm(ray)
            count += 1
    assert count >= 12


def detection(one: SceneObject, rng: np.random.Generator, place: float, degrees: float) -> DetectedObject:
    """A detection with errors of these standard deviations [m], [degrees]."""
    angle, axis = np.radians(degrees), one.pose[:3, 2]
    off = pin.exp3(np.cross(axis, rng.normal(0.0, angle, 3))) @ axis
    turn = angle**2 * np.eye(3) + (3.0 - angle**2) * np.outer(off, off)
    covariance = np.block([[turn, np.zeros((3, 3))], [np.zeros((3, 3)), place**2 * np.eye(3)]])
    center = one.pose[:3, 3] + rng.normal(0.0, place, 3)
    return DetectedObject(one.kind, 0.9, center, off, covariance, one.size[[0, 2]], np.full(2, 0.1), (0, 0, 9, 9), 20)


def test_fits_from_detections_are_closer(scenes: list[ObjectScene], robot: Robot) -> None:
    palm, rng, before, after = robot.hands["left_hand"].palm, np.random.default_rng(3), [], []
    for scene in scenes:
        for one in scene.objects:
            if one.held or not one.inside or one.seen < 0.9:
                continue
            body = held_object(one.kind, one.size, palm, -1, name=one.kind, meshes=DATA)
            guess = detection(one, rng, 0.008, 6.0)
            found = DetectionFit(robot, {one.kind: body}).refine(scene.frame, [guess])[0]
            if not found.reason:
                before.append(np.linalg.norm(guess.center - one.pose[:3, 3]))
                after.append(np.linalg.norm(found.pose[:3, 3] - one.pose[:3, 3]))
    assert len(after) >= 6
    assert np.median(after) < 0.005 < 0.5 * np.median(before)


def test_a_detection_and_a_grasp_are_fused_by_their_covariances(scenes: list[ObjectScene], robot: Robot) -> None:
    scene, rng = scenes[0], np.random.default_rng(4)
    finder = HeldObjectFinder(robot, scene.reported)
    for one, true in zip(finder.expected(scene.frame.state(robot.joint_names)), scene.objects, strict=False):
        guess = detection(true, rng, 0.005, 5.0)
        found = with_detection(one, guess)
        a, b = one.covariance[3:, 3:], guess.covariance[3:, 3:]
        weighted = np.linalg.solve(a, one.pose[:3, 3]) + np.linalg.solve(b, guess.center)
        both = np.linalg.solve(np.linalg.inv(a) + np.linalg.inv(b), weighted)
        np.testing.assert_allclose(found.pose[:3, 3], both, atol=1e-9)
        assert np.linalg.eigvalsh(one.covariance - found.covariance)[0] > -1e-12
        if true.kind == "ball":
            np.testing.assert_allclose(found.pose[:3, :3], one.pose[:3, :3])
        elif true.kind not in OPEN:
            turned = DetectedObject(**{**guess.__dict__, "axis": -guess.axis})
            np.testing.assert_allclose(with_detection(one, turned).pose, found.pose, atol=1e-9)
        assert nearest([guess], true.kind, one, 0.2) is guess
        assert nearest([guess], true.kind, one, 1e-6) is None and nearest([guess], "none", one) is None


def test_detections_are_matched_to_the_nearest_object_once() -> None:
    def at(x: float) -> SceneObject:
        pose = np.eye(4)
        pose[0, 3] = x
        return SceneObject("can", 1, pose, np.ones(3), False, 1.0, True)

    objects = [at(0.0), at(0.1)]
    centers = [np.array([x, 0.0, 0.0]) for x in (0.04, 0.01, 0.12, 0.5)]
    assert matched(objects, centers) == [0, None, 1, None]
    assert matched([], centers) == [None] * 4


def test_a_folded_network_does_the_same() -> None:
    torch.manual_seed(0)
    network = DetectorNetwork(6, WIDTHS)
    for one in network.modules():
        if isinstance(one, torch.nn.BatchNorm2d):
            for values in (one.running_mean, one.running_var, one.weight, one.bias):
                assert values is not None
                values.data.uniform_(0.3, 1.5)
    image, fine = network_input(torch.rand(2, 3, 32, 48), torch.rand(2, 1, 32, 48)), torch.rand(2, 4, 8, 12)
    with torch.inference_mode():
        before, after = network.eval()(image, fine), folded(network)(image, fine)
    assert not any("running" in name for name in folded(network).state_dict())
    for a, b in zip(before, after, strict=True):
        assert a.shape[2:] == (8, 12)
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint with random weights."""
    torch.manual_seed(0)
    state = DetectorNetwork(len(KINDS), WIDTHS, normalized=False).state_dict()
    weights = save_arrays({name: value.half().numpy() for name, value in state.items()})
    made = {name: one.model_dump(mode="json") for name, one in spreads().items()}
    config = {
        "schema": SCHEMA, "kinds": KINDS, "widths": WIDTHS, "spreads": made, "least_score": 0.5,
        "digest": hashlib.sha256(weights).hexdigest(), "trained": {},
    }  # fmt: skip
    (tmp_path / "model.safetensors").write_bytes(weights)
    (tmp_path / "config.json").write_text(json.dumps(config))
    return tmp_path


def test_a_checkpoint_is_read(folder: Path) -> None:
    detector = ObjectDetector.load(folder, DetectorSettings(least_score=0.9))
    assert detector.config.widths == WIDTHS and detector.settings.least_score == 0.9


def changed(folder: Path, **values: object) -> None:
    file = folder / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def test_broken_checkpoints_are_refused_in_a_sentence(folder: Path) -> None:
    with pytest.raises(MissingFileError, match=r"config\.json"):
        ObjectDetector.load(folder / "nowhere")
    good = (folder / "config.json").read_text()
    for values, what in (
        ({"schema": "apex-ompl/detector/9"}, "schema"),
        ({"widths": [4, 4, 4, 4, 8]}, "weights that fit"),
        ({"widths": [4, 4]}, "widths"),
        ({"spreads": {}}, "spreads"),
        ({"kinds": ["box", "dog"]}, "kinds"),
    ):
        changed(folder, **values)
        with pytest.raises(FileFormatError, match=what):
            ObjectDetector.load(folder)
        (folder / "config.json").write_text(good)
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-7])
    with pytest.raises(FileFormatError, match="damaged"):
        ObjectDetector.load(folder)
    weights.unlink()
    with pytest.raises(MissingFileError, match=r"model\.safetensors"):
        ObjectDetector.load(folder)


def test_bad_input_is_refused(folder: Path, robot: Robot) -> None:
    detector = ObjectDetector.load(folder)
    camera = Camera(width=64, height=48, focal=(60.0, 60.0), center=(31.5, 23.5))
    frame = Frame(camera, np.zeros((48, 64)))
    assert detector.find(frame) == ()  # without colors and depths
    on_link = Frame(camera.model_copy(update={"link": "left_link7"}), frame.depth)
    with pytest.raises(ApexError, match="pose"):
        detector.find(on_link)
    assert detector.find(on_link, look_at((1.0, 0.0, 1.0), (0.0, 0.0, 0.0))) == ()
    for given in (None, "frame", np.zeros((48, 64))):
        with pytest.raises(ApexError, match="frame"):
            detector.find(given)  # type: ignore[arg-type]
    for name, value in (("least_score", 2.0), ("reach", 0.0), ("few", float("nan")), ("least_object", -0.1)):
        with pytest.raises(ApexError, match=name):
            DetectorSettings(**{name: value})
    with pytest.raises(ApexError, match="dog"):
        DetectionFit(robot, {"dog": held_object("can", NOMINAL["can"].size, "left", -1, name="can", meshes=DATA)})
    for settings in ({"lying": 2.0}, {"free": (3, 1)}, {"textures": float("nan")}):
        with pytest.raises(ApexError):
            ObjectSettings(**settings)  # type: ignore[arg-type]


def test_torch_is_imported_by_loading_only() -> None:
    program = (
        "import sys, apex_ompl.perception.detector, apex_ompl.perception.detection_fit; print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "False"


def test_the_detector_that_ships_finds_objects_on_tables(scenes: list[ObjectScene]) -> None:
    detector, found, errors, total = ObjectDetector.load(), 0, [], 0
    for scene in scenes:
        answers = detector.find(scene.frame)
        assert [one.score for one in answers] == sorted((one.score for one in answers), reverse=True)
        owners = matched(scene.objects, [one.center for one in answers])
        for k, true in enumerate(scene.objects):
            if true.held or not true.inside or true.seen < 0.9:
                continue
            total += 1
            if k in owners and answers[owners.index(k)].kind == true.kind:
                found += 1
                errors.append(np.linalg.norm(answers[owners.index(k)].center - true.pose[:3, 3]))
    assert total >= 8 and found >= total // 3
    assert np.median(errors) < 0.02


def test_the_checkpoint_that_ships_is_small_and_has_a_card() -> None:
    assert sum(file.stat().st_size for file in SHIPPED.iterdir()) < 1e6
    card = (SHIPPED / "README.md").read_text()
    assert all(f"| {kind} |" in card for kind in KINDS) and "No frame was real" in card
