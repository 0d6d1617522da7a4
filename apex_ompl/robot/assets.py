"""Files of robots: data of this package and of installed packages of robot descriptions."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from apex_ompl.errors import MissingFileError
from apex_ompl.util.files import is_file

DATA = Path(__file__).parent / "data"
EXTRA = "example-robot-data"  # the package of the extra


@cache
def package_roots() -> tuple[Path, ...]:
    """Folders in which ``package://NAME/...`` is looked up, in order.

    They are the entries of ``ROS_PACKAGE_PATH``, then the folder of this package that has the Panda, then the ``share``
    folder that belongs to the installed Pinocchio (the PyPI wheel of ``example-robot-data`` has no Python module and
    installs its files there).
    """
    import pinocchio

    roots = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    roots.append(DATA / "packages")
    roots += [parent / "share" for parent in Path(pinocchio.__file__).resolve().parents]
    return tuple(root for root in roots if root.is_dir())


def resolve(uri: str, relative_to: Path, role: str) -> Path:
    """Return the file that ``uri`` names.

    Args:
        uri: ``package://NAME/path``, ``file:///path``, an absolute path, or a path relative to
            ``relative_to``.
        relative_to: Folder for relative paths.
        role: Description of the file for the error.

    Raises:
        MissingFileError: No such file.
    """
    if uri.startswith("package://"):
        rest = uri.removeprefix("package://")
        for root in package_roots():
            if is_file(root / rest):
                return root / rest
        package = rest.split("/", 1)[0]
        extra = ", as the extra 'robots' of apex_ompl does" if package == EXTRA else ""
        raise MissingFileError(uri, role, f"not under any package folder; is {package!r} installed{extra}?")
    path = Path(uri.removeprefix("file://"))
    path = path if path.is_absolute() else relative_to / path
    if not is_file(path):
        raise MissingFileError(str(path), role)
    return path
