"""URDFs as users have them: files, xacro files, and packages by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apex_ompl.errors import ParameterError, RobotError
from apex_ompl.robot.config import resolve
from apex_ompl.util.extras import import_extra

XACRO = ".xacro"


def package_map(pairs: Mapping[str, str]) -> dict[str, Path]:
    """Return package name -> absolute folder.

    Raises:
        ParameterError: There is no such folder.
    """
    found = {}
    for name, folder in pairs.items():
        path = Path(folder).expanduser().resolve()
        if not path.is_dir():
            raise ParameterError("--package", f"{name}={folder}", "NAME=FOLDER with a folder that exists")
        found[name] = path
    return found


def urdf_file(source: str, packages: Mapping[str, Path]) -> Path:
    """Return the absolute path of a URDF or a xacro file, given by path or as ``package://NAME/path``.

    Raises:
        MissingFileError: There is none.
    """
    return resolve(source, Path.cwd(), "URDF", packages).resolve()


def is_xacro(file: Path) -> bool:
    """Whether a file is to be expanded by xacro."""
    return file.suffix.lower() == XACRO


def expanded(file: Path) -> str:
    """Return the URDF that a xacro file describes, by its default arguments.

    Raises:
        MissingFileError: The package xacro is not installed.
        RobotError: xacro finds a fault.
    """
    xacro: Any = import_extra("xacro", "xacro files", "xacro")
    try:
        return str(xacro.process_file(str(file)).toprettyxml(indent=" "))
    except (Exception, SystemExit) as error:  # xacro raises many kinds
        raise RobotError(f"{file}: xacro cannot expand it ({' '.join(str(error).split())})") from error
