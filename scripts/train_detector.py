"""Make the data of the detector of objects, train it, and write its checkpoint.

Usage: python scripts/train_detector.py make [--folder FOLDER] [--frames 5000]
       python scripts/train_detector.py train [--folder FOLDER] [--steps 4800] [--batch 8]
       python scripts/train_detector.py save [--folder FOLDER] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import hashlib
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from safetensors.numpy import save as save_arrays

from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.detector import (
    CELL,
    FOCAL,
    KINDS,
    OPEN,
    SCHEMA,
    SHIPPED,
    SIZE_UNIT,
    SIZES,
    UNIT,
    DetectorConfig,
    KindSpread,
    ObjectDetector,
    cell_rays,
    cells_of,
    grouped,
    in_cells,
    ray_frames,
)
from apex_ompl.perception.detector_network import FAR, DetectorNetwork, Votes, folded, network_input
from apex_ompl.perception.detector_scenes import TRAINING, ObjectScene, ObjectSceneGenerator, SceneObject, matched
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.synthetic import SyntheticSettings, default_camera
from apex_ompl.problems.objects import DATA
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.torch_model import write_checkpoint
from apex_ompl.util import provenance
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder

ROOT = Path(__file__).resolve().parents[1]
CHI_1, CHI_2 = 2.706, 4.605  # 90th percentiles of chi-squared of one and of two degrees of freedom
SHARD = 250  # frames of a file
SEEDS = {"train": 7301, "validation": 7302}
MOST = 12  # objects of a frame
LENS = np.array([FOCAL, FOCAL, 159.5, 119.5])
CROP = (160, 192)  # of a frame that is trained on [pixels]
CENTERED = 0.85  # share of these around an object
RATE = 3e-3  # largest learning rate
EVERY = 100  # steps from one report to the next
FARTHEST = 1.5  # largest place that is a vote, in units of ``UNIT``
FIELDS = 12  # kind, held, share seen, center, axis, radius, half length, label's place


def training_camera() -> Camera:
    """Return a camera of 320 x 240 pixels, with the focal length that the network sees."""
    found = default_camera(SyntheticSettings())
    depth = found.depth.model_copy(update={"correlation": found.depth.correlation // 2})
    lens = {"width": 320, "height": 240, "focal": (FOCAL, FOCAL), "center": (159.5, 119.5), "depth": depth}
    return found.model_copy(update=lens)


def packed(scene: ObjectScene) -> dict[str, np.ndarray]:
    """Return what trainings use of a scene, all in the true optical frame."""
    millimeters = np.round(scene.frame.depth * 1e3).astype(np.uint16)
    cells = cells_of(millimeters.astype(float) * 1e-3)
    labels, about = in_cells(scene.labels, cells.pixel), np.full((MOST, FIELDS), -1.0, np.float32)
    owner = np.zeros(labels.shape, np.uint8)
    rotation, eye = scene.camera[:3, :3], scene.camera[:3, 3]
    for k, one in enumerate(scene.objects[:MOST]):
        center, axis = (one.pose[:3, 3] - eye) @ rotation, one.pose[:3, 2] @ rotation
        numbers = KINDS.index(one.kind), one.held, one.seen, *center, *axis, one.size[0], one.size[2], one.inside
        about[k] = numbers
        owner[labels == one.label] = k + 1
    owner[cells.depth <= 0.0] = 255
    return {
        "color": scene.frame.color, "depth": millimeters, "owner": owner, "objects": about,
        "up": rotation[2].astype(np.float32),
    }  # fmt: skip


def make(folder: Path, part: str, frames: int) -> None:
    """Draw frames and write them in files of ``SHARD``; files that are there already are kept."""
    make_folder(folder, "folder of the detector's data")
    generator = ObjectSceneGenerator(robot(), DATA, camera=training_camera())
    for first in range(0, frames, SHARD):
        file = folder / f"{part}-{first // SHARD:03d}.npz"
        if file.is_file():
            continue
        drawn = [
            packed(generator.draw_objects(np.random.default_rng((SEEDS[part], k)), TRAINING))
            for k in range(first, first + SHARD)
        ]
        unfinished = file.with_suffix(".part.npz")
        np.savez_compressed(unfinished, **{name: np.stack([one[name] for one in drawn]) for name in drawn[0]})
        unfinished.replace(file)
        print(file.name, flush=True)


class Data:
    """Frames of a part in memory.

    Attributes:
        arrays: Arrays of frames by name, as :func:`packed` has them, and ``near``, the depths of cells [mm].
    """

    def __init__(self, folder: Path, part: str, most: int | None = None) -> None:
        """Read the files of a part, the first ``most`` of them."""
        files = sorted(folder.glob(f"{part}-[0-9][0-9][0-9].npz"))[:most]
        if not files:
            raise MissingFileError(str(folder), "folder of the detector's data", "expected files made by `make`")
        read = [dict(np.load(file)) for file in files]
        for one in read:
            one["near"] = np.stack([cells_of(image.astype(float)).depth for image in one["depth"]]).astype(np.uint16)
        self.arrays = {name: np.concatenate([one[name] for one in read]) for name in read[0]}

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.arrays["depth"])


def crop(data: Data, k: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return a part of a frame around an object, or anywhere, mirrored at random, with the rays of its cells."""
    height, width = CROP
    owner, objects = data.arrays["owner"][k], data.arrays["objects"][k]
    rows, columns = (n * CELL for n in owner.shape)
    middle = rng.uniform((0, 0), (rows, columns))
    seen = np.unique(owner[(owner > 0) & (owner < 255)])
    if len(seen) and rng.random() < CENTERED:
        x, y, z = objects[rng.choice(seen) - 1, 3:6]
        middle = np.array([FOCAL * y / z + LENS[3], FOCAL * x / z + LENS[2]]) + rng.uniform(-60.0, 60.0, 2)
    top, left = ((middle - np.array(CROP) / 2) / CELL).clip(0, (np.array([rows, columns]) - CROP) // CELL).astype(int)
    cells = slice(top, top + height // CELL), slice(left, left + width // CELL)
    pixels = slice(top * CELL, top * CELL + height), slice(left * CELL, left * CELL + width)
    found = {name: data.arrays[name][k][pixels] for name in ("color", "depth")}
    found |= {name: data.arrays[name][k][cells] for name in ("owner", "near")}
    found["rays"] = cell_rays(LENS, found["owner"].shape, (top * CELL, left * CELL)).astype(np.float32)
    found |= {"objects": objects, "up": data.arrays["up"][k]}
    return mirrored(found) if rng.random() < 0.5 else found


def mirrored(given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the mirror image of a part of a frame."""
    found = {name: given[name][:, ::-1] for name in ("color", "depth", "owner", "near", "rays")}
    found |= {name: given[name].copy() for name in ("rays", "objects", "up")} | {"rays": found["rays"].copy()}
    found["rays"][..., 0] *= -1.0
    found["objects"][:, [3, 6]] *= -1.0
    found["up"][0] *= -1.0
    return found


def whole(data: Data, k: int) -> dict[str, np.ndarray]:
    """Return a frame with the rays of its cells."""
    found = {name: values[k] for name, values in data.arrays.items()}
    return found | {"rays": cell_rays(LENS, found["owner"].shape).astype(np.float32)}


def batch(items: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    """Return tensors of input and targets of parts of frames."""
    import torch

    rays = np.stack([one["rays"] for one in items])
    near = np.stack([one["near"] for one in items]).astype(np.float32) * 1e-3
    owner = np.stack([one["owner"] for one in items]).astype(np.int64)
    frames = ray_frames(rays).astype(np.float32)
    local = frames.swapaxes(-1, -2)
    up = np.einsum("nhwij,nj->nhwi", local, np.stack([one["up"] for one in items]))
    there = (owner > 0) & (owner < 255)
    table = np.stack([one["objects"] for one in items])
    mine = table[np.arange(len(items))[:, None, None], np.where(there, owner - 1, 0)]
    kind = np.where(there, mine[..., 0], -1.0).astype(np.int64)
    away = np.einsum("nhwij,nhwj->nhwi", local, mine[..., 3:6] - rays * near[..., None]) / UNIT
    axis = np.einsum("nhwij,nhwj->nhwi", local, mine[..., 6:9])
    size = np.log(np.maximum(mine[..., 9:11], 1e-3) / np.array(SIZES, np.float32)[kind]) / SIZE_UNIT
    votes = there & (np.abs(away).max(axis=-1) < FARTHEST)
    count = np.stack([np.bincount(one.ravel(), minlength=256)[one] for one in owner])
    weight = np.where(votes, 1.0 / np.sqrt(np.maximum(count, 4)), 0.0).astype(np.float32)
    images = np.stack([one["color"] for one in items]).transpose(0, 3, 1, 2).astype(np.float32) / 255.0
    depths = np.stack([one["depth"] for one in items])[:, None].astype(np.float32) * 1e-3

    def channels_first(values: np.ndarray) -> Any:
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(values, -1, 1), np.float32))

    return {
        "color": torch.from_numpy(images), "depth": torch.from_numpy(depths), "kind": torch.from_numpy(kind),
        "fine": torch.cat([channels_first(up), torch.from_numpy((near - FAR)[:, None].astype(np.float32))], dim=1),
        "known": torch.from_numpy(owner != 255), "weight": torch.from_numpy(weight), "away": channels_first(away),
        "axis": channels_first(axis), "size": channels_first(size),
    }  # fmt: skip


def varied(color: Any, generator: Any) -> Any:
    """Return colors, shape (N, 3, H, W), with random gain and offset; some gray, some without any content."""
    import torch

    n = len(color)
    gain = 0.7 + 0.6 * torch.rand(n, 3, 1, 1, generator=generator)
    offset = 0.15 * (torch.rand(n, 1, 1, 1, generator=generator) - 0.5)
    luck = torch.rand(n, 1, 1, 1, generator=generator)
    color = torch.where(luck < 0.1, color.mean(dim=1, keepdim=True).expand_as(color), color)
    return torch.where(luck > 0.93, torch.full_like(color, 0.5), (color * gain + offset).clamp(0.0, 1.0))


def losses(votes: Any, given: dict[str, Any]) -> dict[str, Any]:
    """Return the terms of the loss."""
    import torch
    from torch.nn import functional

    weight, kind = given["weight"], given["kind"]
    total = weight.sum().clamp(min=1e-6)
    there = torch.logsumexp(votes.kinds[:, 1:], dim=1) - votes.kinds[:, 0]
    found = functional.binary_cross_entropy_with_logits(there, (kind >= 0).float(), reduction="none")
    balance = torch.where(kind >= 0, 6.0 * weight, torch.ones_like(weight)) * given["known"]
    named = functional.cross_entropy(votes.kinds[:, 1:], kind.clamp(min=0), reduction="none")
    off = (votes.center - given["away"]).abs().mean(dim=1)
    spread = votes.spread[:, 0].clamp(-4.0, 1.0)
    a = given["axis"]
    tensor = torch.cat([a * a, a[:, [0]] * a[:, [1]], a[:, [0]] * a[:, [2]], a[:, [1]] * a[:, [2]]], dim=1)
    long = weight * (kind != KINDS.index("ball"))
    ends = weight * sum((kind == KINDS.index(name)) for name in OPEN)
    return {
        "object": (balance * found).sum() / balance.sum(),
        "kind": (weight * named).sum() / total,
        "center": (weight * (off / spread.exp() + spread)).sum() / total,
        "axis": (long * (votes.axis - tensor).abs().mean(dim=1)).sum() / long.sum().clamp(min=1e-6),
        "sign": (ends * (votes.sign - a).abs().mean(dim=1)).sum() / ends.sum().clamp(min=1e-6),
        "size": (weight * (votes.size - given["size"]).abs().mean(dim=1)).sum() / total,
        "off": (weight * off).sum().detach() / total,
    }  # fmt: skip


WEIGHTS = {"object": 2.0, "kind": 1.0, "center": 1.0, "axis": 8.0, "sign": 2.0, "size": 0.2}
"""Factors of the terms of the loss."""


def train(folder: Path, steps: int, size: int) -> None:
    """Train, or go on with an interrupted training."""
    import torch

    torch.set_num_threads(1)
    data, seen = Data(folder, "train"), Data(folder, "validation", 1)
    torch.manual_seed(0)
    network = DetectorNetwork(len(KINDS)).to(memory_format=torch.channels_last)
    averaged = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.998), use_buffers=True
    )
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=0.01)
    state, step, spent = folder / "state.pt", 0, 0.0
    if state.is_file():
        kept = torch.load(state, weights_only=True)
        network.load_state_dict(kept["network"])
        averaged.load_state_dict(kept["averaged"])
        optimizer.load_state_dict(kept["optimizer"])
        step, spent = kept["step"], kept["spent"]
    sums: dict[str, float] = {}
    started = time.process_time()
    while step < steps:
        rng, generator = np.random.default_rng((3, step)), torch.Generator().manual_seed(step)
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 200) * (0.5 + 0.5 * math.cos(math.pi * step / steps)) + 1e-5
        given = batch([crop(data, k, rng) for k in rng.integers(len(data), size=size)])
        with torch.autocast("cpu", torch.bfloat16):
            image = network_input(varied(given["color"], generator), given["depth"])
            votes = network(image.contiguous(memory_format=torch.channels_last), given["fine"])
        terms = losses(Votes(*(part.float() for part in votes)), given)
        loss = sum(WEIGHTS[name] * terms[name] for name in WEIGHTS)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        averaged.update_parameters(network)
        step += 1
        for name, value in terms.items():
            sums[name] = sums.get(name, 0.0) + value.item()
        if step % EVERY == 0 or step == steps:
            total = spent + time.process_time() - started
            torch.save(
                {"network": network.state_dict(), "averaged": averaged.state_dict(), "step": step, "spent": total,
                 "optimizer": optimizer.state_dict(), "frames": len(data), "steps": steps}, state.with_suffix(".part")
            )  # fmt: skip
            state.with_suffix(".part").replace(state)
            shown = " ".join(f"{name} {value / EVERY:.3f}" for name, value in sums.items())
            checked = validated(averaged.module, seen)
            print(f"{step} {total:.0f} s, {len(data)} frames: {shown} | {checked}", flush=True)
            sums = {}


def validated(network: Any, data: Data, frames: int = 24) -> str:
    """Return the terms of the loss of some frames."""
    import torch

    network.eval()
    sums: dict[str, float] = {}
    count = min(frames, len(data))
    with torch.inference_mode():
        for k in range(count):
            given = batch([whole(data, k)])
            terms = losses(network(network_input(given["color"], given["depth"]), given["fine"]), given)
            for name, value in terms.items():
                sums[name] = sums.get(name, 0.0) + value.item()
    network.train()
    return " ".join(f"{name} {value / count:.3f}" for name, value in sums.items())


def frames_of(data: Data) -> Iterator[tuple[Frame, tuple[SceneObject, ...]]]:
    """Return frames and their objects, in a world whose up is true."""
    camera = training_camera()
    for k in range(len(data)):
        one = whole(data, k)
        up = one["up"].astype(float)
        pose = np.eye(4)
        pose[:3, :3] = pin.Quaternion.FromTwoVectors(up, np.array([0.0, 0.0, 1.0])).toRotationMatrix()
        objects = []
        for row in one["objects"][one["objects"][:, 0] >= 0].astype(float):
            at, size = pose.copy(), np.array([row[9], row[9], row[10]])
            at[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), pose[:3, :3] @ row[6:9]).matrix()
            at[:3, 3] = pose[:3, :3] @ row[3:6]
            objects.append(SceneObject(KINDS[int(row[0])], 0, at, size, row[1] > 0, float(row[2]), row[11] > 0))
        frame = Frame(camera.placed(pose), one["depth"], one["color"])
        yield frame, tuple(objects)


class Judged(NamedTuple):
    """A candidate of a validation frame.

    Attributes:
        score: Its score.
        kind: The kind that it names.
        right: Whether an object of that kind is there.
        squared: Normalized squared errors across and along the ray and of the axis, and squares of those of sizes.
    """

    score: float
    kind: str
    right: bool
    squared: list[float]


def judged(detector: ObjectDetector, data: Data) -> tuple[list[Judged], int]:
    """Return all candidates of validation frames, and the number of objects that are seen to a half or more."""
    found, total = [], 0
    for frame, objects in frames_of(data):
        pose = frame.camera.pose
        answers = grouped(detector.votes(frame, pose), detector.settings)
        owners = matched(objects, [pose[:3, :3] @ one.center for one in answers])
        total += sum(one.inside and one.seen >= 0.5 for one in objects)
        for one, owner in zip(answers, owners, strict=True):
            kind = KINDS[one.kind]
            if owner is None or objects[owner].kind != kind:
                found.append(Judged(one.score, kind, False, []))
                continue
            true, ray = objects[owner], one.center / np.linalg.norm(one.center)
            off = (true.pose[:3, 3] @ pose[:3, :3] - one.center) / one.spread
            along = float(off @ ray)
            cosine = float((pose[:3, :3] @ one.axis) @ true.pose[:3, 2])
            angle = np.arccos(np.clip(cosine if true.kind in OPEN else abs(cosine), -1.0, 1.0))
            grown = np.log(true.size[[0, 2]] / SIZES[one.kind]) - one.size
            squared = [float(off @ off) - along**2, along**2, angle**2 / max(one.doubt, 1e-4), *np.square(grown)]
            found.append(Judged(one.score, kind, True, [float(value) for value in squared]))
    return found, total


def best_score(found: list[Judged], total: int) -> float:
    """Return the score from which on precision and recall have the best mean (F1)."""
    ordered = sorted(found, key=lambda one: -one.score)
    right = np.cumsum([one.right for one in ordered])
    balance = 2.0 * right / (np.arange(1, len(ordered) + 1) + total)
    return round(ordered[int(np.argmax(balance))].score, 3)


def spreads_of(found: list[Judged]) -> dict[str, KindSpread]:
    """Return standard deviations that give squared errors the 90th percentile of chi-squared."""
    spreads = {}
    for kind in KINDS:
        rows = [one.squared for one in found if one.right and one.kind == kind]
        if not rows:
            raise ParameterError("validation", f"no {kind!r}", "detections of every kind; train longer")
        high = np.sqrt(np.quantile(rows, 0.9, axis=0) / [CHI_2, CHI_1, CHI_2, CHI_1, CHI_1])
        across, along, turn, radius, length = (float(f"{max(v, 1e-3):.3g}") for v in high)
        spreads[kind] = KindSpread(across=across, along=along, turn=turn, size=(radius, length))
    return spreads


def save(folder: Path, out: Path) -> None:
    """Write the checkpoint, with spreads from the validation frames."""
    import torch

    torch.set_num_threads(1)
    kept = torch.load(folder / "state.pt", weights_only=True)
    network = DetectorNetwork(len(KINDS))
    network.load_state_dict({k.removeprefix("module."): v for k, v in kept["averaged"].items() if k != "n_averaged"})
    plain = folded(network)
    weights = save_arrays({k: v.half().contiguous().numpy() for k, v in plain.state_dict().items()})
    plain.load_state_dict({k: v.half().float() for k, v in plain.state_dict().items()})
    ones = {kind: KindSpread(across=1.0, along=1.0, turn=1.0, size=(1.0, 1.0)) for kind in KINDS}
    about = {
        "schema": SCHEMA, "kinds": KINDS, "widths": network.widths, "spreads": ones, "least_score": 0.0,
        "digest": hashlib.sha256(weights).hexdigest(),
        "trained": {
            "step": kept["step"], "steps": kept["steps"], "seconds": round(kept["spent"]), "frames": kept["frames"],
            "seeds": SEEDS, "commit": provenance.commit(ROOT, ["apex_ompl/perception", "scripts/train_detector.py"]),
            "hardware": provenance.hardware(),
        },
    }  # fmt: skip
    found, total = judged(ObjectDetector(plain, DetectorConfig.model_validate(about)), Data(folder, "validation"))
    least = best_score(found, total)
    kept_ones = [one for one in found if one.score >= least]
    config = DetectorConfig.model_validate(about | {"spreads": spreads_of(kept_ones), "least_score": least})
    count = sum(value.numel() for value in plain.state_dict().values())
    right = sum(one.right for one in kept_ones)
    figures = f"precision {right / len(kept_ones):.2f}, recall {right / total:.2f} of {total} objects"
    write_checkpoint(
        out, config.model_dump(mode="json", by_alias=True), weights, card(config, count, kept_ones, figures)
    )
    print(f"{out}: {count} weights, step {kept['step']}; score of {least:g} or more: {figures}")


def card(config: DetectorConfig, weights: int, found: list[Judged], figures: str) -> str:
    """Return the model card, Markdown."""
    t = config.trained
    counts = {kind: sum(one.right and one.kind == kind for one in found) for kind in config.kinds}
    rows = [
        f"| {kind} | {counts[kind]} | {s.across:g} | {s.along:g} | {s.turn:g} | {s.size[0]:g} | {s.size[1]:g} |"
        for kind, s in config.spreads.items()
    ]
    lines = [
        "# A detector of objects",
        "",
        f"{weights / 1e3:.0f} thousand weights of 16 bits: convolutions on color and depth, whose cells of 4 x 4 "
        f"pixels vote for centers, axes, sizes and kinds ({', '.join(config.kinds)}).",
        "",
        f"Trained by `scripts/train_detector.py` at commit {t['commit']} on {t['frames']} rendered frames of 320 x 240 "
        f"pixels (seeds {SEEDS['train']} and index; validation {SEEDS['validation']}), step {t['step']} of "
        f"{t['steps']}, {t['seconds'] / 60:.0f} min of one core on {t['hardware']}. Frames are drawn by the kernel's "
        "own renderer, with random light, textures, gain, clutter and cameras, of a robot with two hands and objects "
        "in them, on its tables and in the air. No frame was real.",
        "",
        f"On validation frames, objects that are seen to a half or more and scores of {config.least_score:g} or more: "
        f"{figures} (kind right, center within 6 cm).",
        "",
        "Errors on validation frames, as standard deviations over what votes expect (center across and along the ray; "
        "axis), and of logarithms of sizes:",
        "",
        "| kind | objects | across | along | axis | radius | half length |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        *rows,
        "",
        "Errors on test frames of two renderers are in `benchmarks/results/perception_detector.md`. "
        "`apex_ompl.perception.ObjectDetector` reads it.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    steps = "make: draw frames (0.1 s and 0.25 MB each, on one core); train: 4800 steps take 9 minutes of a core; "
    steps += "save: write the checkpoint, with spreads from the validation frames (a minute)"
    parser.add_argument("step", choices=("make", "train", "save"), help=steps)
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/detector"), help="of data and training (default: %(default)s)"
    )
    parser.add_argument("--frames", type=int, default=5000, help="to draw for the training (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=4800, help="of the training (default: %(default)s)")
    parser.add_argument("--batch", type=int, default=8, help="parts of frames in a step (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=SHIPPED, help="checkpoint to write (default: the one that ships)")
    given = parser.parse_args()
    if given.step == "make":
        make(given.folder, "validation", 500)
        make(given.folder, "train", given.frames)
    if given.step == "train":
        train(given.folder, given.steps, given.batch)
    if given.step == "save":
        save(given.folder, given.out)


if __name__ == "__main__":
    run_script(main)
