"""Checkpoints: folders of ``config.json``, ``model.safetensors`` and a model card; nothing in them is executed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.model.array_model import ArrayModel, check_scales, is_scale, is_supported, weight_shapes
from apex_ompl.model.config import ModelConfig
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.util.files import BROKEN, is_file, path_text, read_file
from apex_ompl.util.forking import ProcessLock
from apex_ompl.util.schema import StrictModel, read_record

SCHEMA = "apex-ompl/model/1"
SHIPPED = Path(__file__).parent / "checkpoints"
CONFIG, WEIGHTS = "config.json", "model.safetensors"
ROLE = "file of a checkpoint"
TORCH = "apex_ompl.training.torch_model"  # for models that NumPy cannot evaluate; by name, since model knows no torch
T = TypeVar("T")
PICKLES = (".pt", ".pth", ".ckpt", ".bin", ".pkl", ".pickle")


class CheckpointConfig(StrictModel):
    """Content of ``config.json``.

    Attributes:
        schema_: Version of the format.
        model: Configuration of the model.
        digest: SHA-256 of the file of weights.
        trained: Record of the training.
    """

    schema_: Literal["apex-ompl/model/1"] = Field(alias="schema")
    model: ModelConfig
    digest: str
    trained: dict[str, Any] = {}


def load_model(
    name: str | os.PathLike[str] = "apex", *, device: Any = "cpu", robot: str | None = None
) -> TrajectoryModel:
    """Return a trained model.

    On the CPU, NumPy evaluates the models that it can; torch is imported only for the others.

    Args:
        name: Name of a checkpoint that ships, ``apex`` or ``apex-paper``, or a folder.
        device: Torch device that it computes on, or its name.
        robot: Name of the robot that the model must be for; by default any.

    Raises:
        UnknownNameError: No checkpoint of that name ships, and there is no such folder.
        MissingFileError: A file of the checkpoint is missing.
        FileFormatError: The checkpoint is damaged, a pickle, of another version, or for another robot.
        ParameterError: There is no such device.
    """
    config, weights, source = read_checkpoint(name, robot)
    if str(device) == "cpu" and is_supported(config.model):
        check_shapes(weights, lambda: weight_shapes(config.model), source)
        return ArrayModel(config.model, weights, config.trained)
    found: TrajectoryModel = import_module(TORCH).torch_model(config, weights, source, device)
    return found


def read_checkpoint(
    name: str | os.PathLike[str], robot: str | None
) -> tuple[CheckpointConfig, dict[str, NDArray[Any]], Path]:
    """Return configuration, weights, and file of weights of a checkpoint; arguments as of :func:`load_model`.

    Raises:
        UnknownNameError, MissingFileError, FileFormatError: As :func:`load_model` does.
    """
    folder = checkpoint_folder(name)
    for file in (CONFIG, WEIGHTS):
        if not is_file(folder / file):
            raise MissingFileError(str(folder / file), ROLE)
    source = folder / WEIGHTS
    config = read_config(folder)
    if robot is not None and config.model.robot != robot:
        raise FileFormatError(str(folder / CONFIG), "model.robot", config.model.robot, f"expected {robot!r}")
    return config, read_weights(source, config.digest), source


def read_weights(source: Path, digest: str, role: str = ROLE) -> dict[str, NDArray[Any]]:
    """Return the weights in a file of a checkpoint by name, matrices in eight bits with their scales.

    Args:
        source: The file.
        digest: SHA-256 digest that it must have.
        role: Description of the file for the error.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is damaged, or has weights that are not finite.
    """
    content = read_file(source, role)
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise FileFormatError(str(source), "", f"SHA-256 {found[:12]}...", f"expected {digest[:12]}...: damaged")
    try:
        weights = load_arrays(content)
        check_scales(weights)
    except (SafetensorError, ValueError, KeyError) as error:
        raise FileFormatError(str(source), "", str(error), "expected safetensors") from error
    for key, values in weights.items():
        if values.dtype != np.int8 and not np.isfinite(values).all():
            raise FileFormatError(str(source), key, "numbers that are not finite", "expected finite weights")
    return weights


def check_shapes(
    weights: Mapping[str, NDArray[Any]], expected: Callable[[], dict[str, tuple[int, ...]]], source: Path
) -> None:
    """Check that weights fit a configuration.

    Raises:
        FileFormatError: They do not, or there is no such model.
    """
    try:
        wanted = expected()
    except (*BROKEN, ParameterError) as error:
        can_be_made = "expected the configuration of a model that can be made"
        raise FileFormatError(str(source.parent / CONFIG), "model", str(error), can_be_made) from error
    shapes = {key: tuple(values.shape) for key, values in weights.items() if not is_scale(key, weights)}
    wrong = sorted(set(wanted.items()) ^ set(shapes.items()))
    if wrong:
        fits = f"expected weights that fit {CONFIG}"
        raise FileFormatError(str(source), wrong[0][0], shapes.get(wrong[0][0], "nothing"), fits)


def shared_model(name: str | os.PathLike[str], *, device: str = "cpu", robot: str | None = None) -> TrajectoryModel:
    """Return a trained model from a cache; it is read again when its files change.

    Raises:
        ApexError: As :func:`load_model` does.
    """
    return _shared(checkpoint_folder(name), device=device, robot=robot)


class FolderCache(Generic[T]):
    """What was last loaded from up to four folders of weights; it is loaded again when their files change."""

    def __init__(self, load: Callable[..., T]) -> None:
        """Load by a function of the folder's path, a text, and of options by name."""
        self._lock = ProcessLock()
        self._kept = lru_cache(maxsize=4)(lambda folder, stamp, **options: load(folder, **options))

    def __call__(self, folder: Path, **options: Any) -> T:
        """Return what is in a folder, from the cache where its files are as they were."""
        files = [folder / file for file in (CONFIG, WEIGHTS)]
        stamp = tuple(file.stat().st_mtime_ns for file in files if is_file(file))
        with self._lock:
            return self._kept(str(folder.absolute()), stamp, **options)


_shared = FolderCache(load_model)


def read_config(folder: Path) -> CheckpointConfig:
    """Read the configuration of a checkpoint.

    Raises:
        FileFormatError: The file is not one.
    """
    return read_record(folder / CONFIG, CheckpointConfig, ROLE)


def shipped() -> tuple[str, ...]:
    """Names of the checkpoints that ship."""
    return tuple(sorted(path.parent.name for path in SHIPPED.glob(f"*/{CONFIG}")))


def checkpoint_folder(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a checkpoint by its name or folder.

    Raises:
        ApexError: There is none.
    """
    text = path_text(name, "model")
    if text in shipped():
        return SHIPPED / text
    folder = Path(text)
    try:
        if folder.is_dir():
            return folder
        if folder.suffix in PICKLES:
            expected = f"expected a checkpoint's folder ({CONFIG}, {WEIGHTS}); pickles are not read"
            raise FileFormatError(text, "", folder.suffix, expected)
    except (OSError, ValueError) as error:
        raise MissingFileError(text, "checkpoint", "no folder can have this name") from error
    if os.sep in text or folder.exists():
        raise MissingFileError(text, "checkpoint", "no such folder")
    raise UnknownNameError("checkpoint", text, shipped())
