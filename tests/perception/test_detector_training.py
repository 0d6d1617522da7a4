"""The training of the detector: its script, its targets, and that it learns."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from support import ROOT

from apex_ompl.perception.detector import KINDS, ObjectDetector
from apex_ompl.perception.detector_network import Votes


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("train_detector", ROOT / "scripts" / "train_detector.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["train_detector"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(script: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data of three frames each for the training and for validation."""
    found = tmp_path_factory.mktemp("detector")
    kept, script.SHARD = script.SHARD, 3
    script.make(found, "validation", 3)
    script.make(found, "train", 3)
    script.SHARD = kept
    return found


def test_frames_are_those_of_their_seeds(script: ModuleType, folder: Path) -> None:
    first, again = script.Data(folder, "train"), folder / "train-000.npz"
    before = again.stat().st_mtime_ns
    script.make(folder, "train", 3)
    assert again.stat().st_mtime_ns == before  # files that are there are kept
    assert len(first) == 3 and not np.array_equal(
        first.arrays["depth"], script.Data(folder, "validation").arrays["depth"]
    )
    owner, objects = first.arrays["owner"], first.arrays["objects"]
    for k in range(3):
        for number in np.unique(owner[k][(owner[k] > 0) & (owner[k] < 255)]):
            x, y, z = objects[k, number - 1, 3:6]
            rows, columns = np.nonzero(owner[k] == number)
            middle = np.array([232.5 * y / z + 119.5, 232.5 * x / z + 159.5]) / 4.0
            if len(rows) > 8:
                assert np.abs(middle - [rows.mean(), columns.mean()]).max() < 8.0


def perfect(given: dict[str, torch.Tensor]) -> Votes:
    """Votes that are the targets."""
    kinds = torch.nn.functional.one_hot(given["kind"] + 1, len(KINDS) + 1).permute(0, 3, 1, 2) * 30.0
    a = given["axis"]
    tensor = torch.cat([a * a, a[:, [0]] * a[:, [1]], a[:, [0]] * a[:, [2]], a[:, [1]] * a[:, [2]]], dim=1)
    return Votes(kinds, given["away"], torch.full_like(a[:, :1], -4.0), tensor, a, given["size"])


def test_targets_have_no_loss_and_do_not_change_by_mirroring(script: ModuleType, folder: Path) -> None:
    data = script.Data(folder, "train")
    plain = script.whole(data, 0)
    given = script.batch([plain, script.mirrored(plain)])
    terms = script.losses(perfect(given), given)
    assert max(terms[name] for name in ("kind", "axis", "sign", "size", "off")) < 1e-6
    here, there = (given["away"][k] for k in (0, 1))
    mine = given["weight"][0] > 0
    assert mine.any()
    turned = there.flip(-1) * torch.tensor([-1.0, 1.0, 1.0])[:, None, None]
    torch.testing.assert_close(turned[:, mine], here[:, mine], atol=1e-4, rtol=0.0)
    for k in range(8):
        part = script.crop(data, 1, np.random.default_rng(k))
        assert part["color"].shape == (160, 192, 3) and part["owner"].shape == part["rays"].shape[:2] == (40, 48)


def test_a_training_goes_on_and_its_checkpoint_is_read(
    script: ModuleType, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(script, "EVERY", 4)
    monkeypatch.setattr(script, "CROP", (64, 64))
    script.train(folder, 4, 2)
    script.train(folder, 8, 2)
    reports = capsys.readouterr().out.splitlines()
    assert [int(one.split()[0]) for one in reports] == [4, 8]
    rows = [script.Judged(0.8, kind, True, [1.0, 4.0, 1.0, 0.01, 0.04]) for kind in KINDS]
    rows += [script.Judged(0.1, "can", False, []) for _ in range(6)]
    monkeypatch.setattr(script, "judged", lambda detector, data: (rows, 8))  # an untrained network finds nothing
    script.save(folder, folder / "checkpoint")
    detector = ObjectDetector.load(folder / "checkpoint")
    assert detector.config.least_score == 0.8
    assert detector.config.trained["step"] == 8 and detector.config.trained["frames"] == 3
    spread = detector.config.spreads["can"]
    assert spread.along == pytest.approx((4.0 / 2.706) ** 0.5, rel=0.01)
    assert spread.across == pytest.approx((1.0 / 4.605) ** 0.5, rel=0.01)
    assert "step 8 of 8" in (folder / "checkpoint" / "README.md").read_text()
    assert "precision 1.00, recall 0.75" in (folder / "checkpoint" / "README.md").read_text()
