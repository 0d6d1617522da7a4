"""Pack the runs of committed tables, or unpack them, so that a clone can remake or extend a table.

``pack`` puts the runs in the folder benchmarks/runs/NAME into benchmarks/packed/NAME.tar.xz; ``unpack`` puts them back,
where the command that made them resumes. Pictures, pages, OMPL's logs and databases are left out: they are made from
the runs.

Usage: python -m benchmarks.lib.pack pack|unpack NAME [NAME ...]    (as: pack head_to_head peers)
"""

from __future__ import annotations

import argparse
import io
import lzma
import tarfile
from pathlib import Path

from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder, write_atomically

RUNS, PACKED = Path(__file__).parents[1] / "runs", Path(__file__).parents[1] / "packed"
KINDS = (".json", ".jsonl")


def pack(name: str) -> Path:
    """Pack the runs of a benchmark; the same runs give the same bytes.

    Raises:
        MissingFileError: There are none.
    """
    files = [file for file in sorted((RUNS / name).rglob("*")) if file.suffix in KINDS and file.is_file()]
    if not files:
        raise MissingFileError(str(RUNS / name), "runs", "expected a folder, as the benchmarks store them")
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for file in files:
            entry, data = tarfile.TarInfo(file.relative_to(RUNS).as_posix()), file.read_bytes()
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
    path = make_folder(PACKED) / f"{name}.tar.xz"
    write_atomically(path, lzma.compress(archive.getvalue(), preset=9))
    return path


def unpack(name: str) -> list[Path]:
    """Unpack the runs of a benchmark.

    Raises:
        MissingFileError: There is no archive, or not one of ``pack``.
        ParameterError: The folder holds other runs.
    """
    path = PACKED / f"{name}.tar.xz"
    try:
        with tarfile.open(path, "r:xz") as tar:
            files = {Path(e.name): found.read() for e in tar if (found := tar.extractfile(e)) is not None}
    except (OSError, EOFError, lzma.LZMAError, tarfile.TarError) as error:
        raise MissingFileError(str(path), "packed runs", f"expected an archive that pack has made ({error})") from error
    for file, data in files.items():
        if (RUNS / file).exists() and (RUNS / file).read_bytes() != data:
            raise ParameterError("name", name, f"one without other runs in {RUNS / file}")
    for file, data in files.items():
        make_folder((RUNS / file).parent)
        write_atomically(RUNS / file, data)
    return [RUNS / file for file in files]


def main() -> None:
    """Pack or unpack."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("pack", "unpack"))
    parser.add_argument("names", nargs="+", metavar="NAME")
    args = parser.parse_args()
    for name in args.names:
        paths = [pack(name)] if args.action == "pack" else unpack(name)
        where = (paths[0] if args.action == "pack" else RUNS / name).relative_to(Path(__file__).parents[2])
        print(f"{where}: {sum(path.stat().st_size for path in paths) / 1024:.0f} KiB")


if __name__ == "__main__":
    run_script(main)
