from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from apex_ompl.errors import ApexError, FileFormatError, FolderInUseError, MissingFileError
from apex_ompl.paths.spline import Spline
from apex_ompl.training.records import FIELDS, DatasetError, Paths, duplicates, from_micro, level_statistics, to_micro
from apex_ompl.training.store import Store, load, save

DOF, FREE = 5, 12
ABOUT = {"robot": "some", "joints": ["a", "b", "c", "d", "e"], **asdict(Spline())}
MANIFEST = {"robot": "some", "seed": 0}


def random_paths(seed: int, problems: int = 3, paths: int = 7, suite: str = "shelf") -> Paths:
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 4, problems)
    total = int(things.sum())
    arrays = {
        "seed": rng.integers(0, 1000, problems), "suite": np.zeros(problems), "level": np.zeros(problems),
        "held": rng.integers(0, 2, problems), "things": things, "shape": rng.integers(0, 4, total),
        "position": rng.normal(size=(total, 3)), "orientation": rng.normal(size=(total, 4)),
        "size": rng.uniform(size=(total, 3)), "problem": np.sort(rng.integers(0, problems, paths)),
        "start": to_micro(rng.normal(size=(paths, DOF))), "goal": to_micro(rng.normal(size=(paths, DOF))),
        "control": rng.normal(size=(paths, FREE, DOF)), "point": rng.normal(size=(paths, 3)),
        "clearance": rng.uniform(size=paths), "length": rng.uniform(1, 9, paths), "source": rng.integers(0, 5, paths),
        "homotopy": rng.integers(0, 2, paths),
    }  # fmt: skip
    names = {"suite": (suite,), "level": ("easy",), "held": ("", "cup")}
    return Paths({k: np.asarray(v).astype(FIELDS[k][0]) for k, v in arrays.items()}, names, ABOUT, {"solved": problems})


def same(a: Paths, b: Paths) -> bool:
    return all(np.array_equal(a.arrays[k], b.arrays[k]) for k in FIELDS) and dict(a.names) == dict(b.names)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "data", MANIFEST, MANIFEST)
    units = {f"unit-{k}": random_paths(k) for k in range(3)}
    for name, paths in units.items():
        store.write(name, paths)
    empty = random_paths(9, 2, 0)
    store.write("unit-9", empty)
    again = Store(tmp_path / "data")
    assert again.units() == [*units, "unit-9"]
    assert all(same(again.read(name), paths) for name, paths in units.items())
    assert len(again.read("unit-9")) == 0 and again.read("unit-0").counts == {"solved": 3}
    assert again.manifest["robot"] == "some"


def test_states_are_exact_to_six_decimals() -> None:
    states = np.round(np.random.default_rng(0).uniform(-3.0, 3.0, (1000, 4)), 6)
    assert np.array_equal(from_micro(to_micro(states)), states)


def test_joined_sets_keep_what_belongs_together(tmp_path: Path) -> None:
    parts = [random_paths(1), random_paths(2, suite="bins"), random_paths(3)]
    joined = Paths.concatenate(parts)
    assert len(joined) == 21 and joined.problems == 9
    seen = 0
    for part, first in zip(parts, (0, 3, 6), strict=True):
        for k in range(len(part)):
            owner = int(joined.arrays["problem"][seen])
            assert owner == first + part.arrays["problem"][k]
            assert joined.problem_name(owner) == part.problem_name(int(part.arrays["problem"][k]))
            assert np.array_equal(joined.arrays["control"][seen], part.arrays["control"][k])
            seen += 1
    chosen = joined.subset([4, 7])
    assert chosen.problems == 2 and set(chosen.arrays["problem"]) <= {0, 1}
    for k, old in enumerate((4, 7)):
        assert chosen.problem_name(k) == joined.problem_name(old)
        mine = joined.arrays["problem"] == old
        assert np.array_equal(chosen.arrays["control"][chosen.arrays["problem"] == k], joined.arrays["control"][mine])
    first = int(joined.arrays["things"][:4].sum())
    count = int(joined.arrays["things"][4])
    assert np.array_equal(chosen.arrays["size"][:count], joined.arrays["size"][first : first + count])
    other = Paths(parts[0].arrays, parts[0].names, {**ABOUT, "robot": "another"})
    with pytest.raises(DatasetError, match="different robots"):
        Paths.concatenate([parts[0], other])
    assert joined.spline == Spline()
    control = joined.control()
    assert np.array_equal(control[:, 0], joined.start) and np.array_equal(control[:, -1], joined.goal)
    with pytest.raises(DatasetError, match="no paths"):
        Paths.concatenate([])


def test_sets_have_more_held_objects_than_a_byte_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = []
    for k in range(300):
        one = random_paths(k)
        parts.append(Paths(one.arrays, {**one.names, "held": (f"first {k}", f"second {k}")}, ABOUT))
    joined = Paths.concatenate(parts)
    assert len(joined.names["held"]) == 600
    for k in (0, 150, 299):
        mine = joined.arrays["held"][3 * k : 3 * k + 3]
        wanted = [parts[k].names["held"][h] for h in parts[k].arrays["held"]]
        assert [joined.names["held"][h] for h in mine] == wanted
    save(tmp_path / "many.zip", joined)
    assert same(load(tmp_path / "many.zip"), joined)
    monkeypatch.setitem(FIELDS, "held", (np.uint8, ()))  # as sets were written before
    save(tmp_path / "old.zip", random_paths(3))
    monkeypatch.undo()
    old = load(tmp_path / "old.zip")
    assert same(old, random_paths(3)) and old.arrays["held"].dtype == np.uint32


def test_a_set_made_otherwise_is_not_gone_on_with(tmp_path: Path) -> None:
    Store.create(tmp_path, MANIFEST, MANIFEST)
    with pytest.raises(DatasetError, match="seed is 0 there, expected 1"):
        Store.create(tmp_path, {**MANIFEST, "seed": 1}, MANIFEST)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**manifest, "schema": "apex-ompl/dataset/99"}))
    with pytest.raises(FileFormatError, match="expected 'apex-ompl/dataset/1', got 'apex-ompl/dataset/99'"):
        Store.create(tmp_path, MANIFEST, MANIFEST)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(FileFormatError, match="manifest"):
        Store(tmp_path)
    with pytest.raises(MissingFileError, match="manifest"):
        Store(tmp_path / "nowhere")


def test_leftovers_of_an_ended_process_are_cleared(tmp_path: Path) -> None:
    store = Store.create(tmp_path, MANIFEST, MANIFEST)
    store.write("unit-0", random_paths(0))
    (tmp_path / "units" / ".unit-1.abc.part").write_bytes(b"half")
    again = Store.create(tmp_path, MANIFEST, MANIFEST)
    assert again.units() == ["unit-0"]
    with again.locked(), pytest.raises(FolderInUseError, match="another process"), Store(tmp_path).locked():
        pass
    assert [p.name for p in (tmp_path / "units").iterdir()] == ["unit-0.zip"]


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store.create(tmp_path, MANIFEST, MANIFEST)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DatasetError, match="unit-0.zip: cannot be written, no space left on device"):
        store.write("unit-0", random_paths(0))
    assert not list((tmp_path / "units").iterdir())


def test_a_disk_that_is_really_full_leaves_nothing_behind(tmp_path: Path) -> None:
    """The system itself refuses to write on."""
    Store.create(tmp_path, MANIFEST, MANIFEST)
    save(tmp_path / "large.zip", random_paths(0, 50, 400))
    code = f"""
import resource, signal
from pathlib import Path
from apex_ompl.training.store import Store, load
from apex_ompl.training.records import DatasetError
paths = load(Path({str(tmp_path / "large.zip")!r}))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    Store({str(tmp_path)!r}).write("unit-0", paths)
except DatasetError as error:
    print("said:", error)
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert "said:" in done.stdout and "unit-0.zip: cannot be written" in done.stdout, done.stderr
    assert not list((tmp_path / "units").iterdir())


def test_damaged_units_are_named(tmp_path: Path) -> None:
    file = tmp_path / "unit.zip"
    save(file, random_paths(0))
    whole = file.read_bytes()
    with pytest.raises(MissingFileError, match="none.zip"):
        load(tmp_path / "none.zip")
    for content in (b"", b"not a zip", whole[: len(whole) // 2], whole[:-40] + b"\0" * 40):
        file.write_bytes(content)
        with pytest.raises(FileFormatError, match="unit.zip"):
            load(file)
    rng = np.random.default_rng(0)
    for _ in range(40):  # any byte may be another one: a clear error, or the same paths
        broken = bytearray(whole)
        broken[int(rng.integers(len(whole)))] ^= 0xFF
        file.write_bytes(bytes(broken))
        try:
            paths = load(file)
        except ApexError:
            continue
        assert same(paths, random_paths(0))
    for name in (b"control/c/0/0/0", b"start/c/0/0"):  # a chunk by another name would read as zeros
        assert whole.count(name) == 2
        file.write_bytes(whole.replace(name, name[:-1] + b"7"))
        with pytest.raises(FileFormatError, match="unit.zip"):
            load(file)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("zarr.json", "{}")
    with pytest.raises(FileFormatError, match="unit.zip"):
        load(file)


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("problem", np.array([9] * 7, np.int32), "problem"),
        ("control", np.zeros((7, FREE, DOF + 1), np.float16), "control"),
        ("control", np.full((7, FREE, DOF), np.nan, np.float16), "control"),
        ("source", np.full(7, 77, np.uint8), "source"),
        ("length", np.zeros(6, np.float32), "lengths"),
        ("things", np.zeros(3, np.uint16), "things"),
        ("start", np.zeros((7, DOF)), "start"),
        ("control", np.zeros((7, 1, DOF), np.float16), "about"),
    ],
)
def test_arrays_that_do_not_fit_are_named(name: str, value: np.ndarray, word: str) -> None:
    paths = random_paths(0)
    with pytest.raises(DatasetError, match=word):
        Paths({**paths.arrays, name: value}, paths.names, ABOUT)


def test_duplicates_and_figures_are_counted() -> None:
    paths = random_paths(0, 2, 6)
    arrays = {k: v.copy() for k, v in paths.arrays.items()}
    for key in ("problem", "start", "goal", "control", "source"):
        arrays[key][3] = arrays[key][1]
    arrays["control"][3] += np.float16(0.01)
    arrays["source"][:] = [1, 2, 3, 2, 4, 0]
    arrays["problem"][:] = [0, 0, 0, 0, 0, 1]
    arrays["homotopy"][:] = [0, 1, 0, 1, 0, 0]
    twins = Paths(arrays, paths.names, ABOUT)
    assert duplicates(twins).tolist() == [False, False, False, True, False, False]
    first, all_of_them = level_statistics(twins)
    assert (first.name, all_of_them.name) == ("shelf/easy", "all")
    assert all_of_them.sources == {"line": 1, "perturbation": 1, "rrtconnect": 2, "reversed": 1, "part": 1, "model": 0}
    assert (all_of_them.straight, all_of_them.homotopies, all_of_them.several) == (0.5, 2.0, 1.0)
    assert all_of_them.duplicates == 1
    assert all_of_them.length[1] == pytest.approx(np.median(arrays["length"]))
