"""Draw problems of every suite and level into docs/pictures/suites, one sheet a suite: start, and goal as a ghost.

The sheets of ``broad`` and ``unseen``, with one problem for each grammar, and of ``constrained``, the levels with
constraints of all suites, are drawn only if they are named.

Usage: python scripts/make_contact_sheets.py [--first 0] [--columns 3] [SUITE ...]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from apex_ompl import problems
from apex_ompl.problems.broad import GRAMMARS
from apex_ompl.problems.catalogue import CONSTRAINED, SPLITS, TRAINING
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import one_or_more, whole_number
from apex_ompl.viz.render import render

OUT = Path(__file__).resolve().parent.parent / "docs" / "pictures" / "suites"
SIZE, DRAWN = (400, 300), (1200, 900)  # of a picture on the sheet, and as it is drawn [pixels]
FROM_BEHIND = {"shelf": 150.0, "swap": 150.0}
FROM_ABOVE_LEFT = 40.0
WITH_CONSTRAINTS = "constrained"
SOME_MOVING = ("moving-small-0.1", "moving-large-0.2", "moving-huge-0.4")


def picture(name: str, azimuth: float) -> Image.Image:
    """Return the picture of a problem with its name."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "problem.png"
        render(problems.load(name), file, DRAWN, azimuth)
        drawn = Image.fromarray(np.asarray(iio.imread(file))[..., :3]).resize(SIZE, Image.Resampling.LANCZOS)
    ImageDraw.Draw(drawn).text((8, 6), name, fill="#222222", font=ImageFont.load_default(14))
    return drawn


def _tiled(names: list[str], columns: int) -> Image.Image:
    """Return the sheet of some problems, by name."""
    whole = Image.new("RGB", (SIZE[0] * columns, SIZE[1] * -(-len(names) // columns)), "white")
    for k, name in enumerate(names):
        whole.paste(picture(name, FROM_ABOVE_LEFT), (k % columns * SIZE[0], k // columns * SIZE[1]))
    return whole


def sheet(suite: str, first: int, columns: int) -> Image.Image:
    """Return the sheet of a suite: a row a level; of ``broad`` and ``unseen`` a problem a level.

    That of ``constrained`` has a row for each suite, with a problem of each level with constraints.
    """
    if suite == WITH_CONSTRAINTS:
        seed = SPLITS["validation"][first]
        return _tiled([f"{one}/{level}/{seed}" for one, levels in CONSTRAINED.items() for level in levels], 3)
    if suite in GRAMMARS:
        split = SPLITS["train" if suite in TRAINING else "validation"]
        return _tiled([f"{suite}/{level}/{split[first]}" for level in GRAMMARS[suite]], columns)
    levels = [v for v in problems.suites()[suite] if not v.startswith("moving") or v in SOME_MOVING]
    whole = Image.new("RGB", (SIZE[0] * columns, SIZE[1] * len(levels)))
    for row, level in enumerate(levels):
        for column in range(columns):
            drawn = picture(f"{suite}/{level}/{first + column}", FROM_BEHIND.get(suite, FROM_ABOVE_LEFT))
            whole.paste(drawn, (column * SIZE[0], row * SIZE[1]))
    return whole


def main() -> None:
    """Draw the sheets of the named suites, or of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("suites", nargs="*")
    parser.add_argument(
        "--first", type=whole_number, default=0, help="seed of the first problem (default: %(default)s)"
    )
    parser.add_argument("--columns", type=one_or_more, default=3)
    args = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    for suite in args.suites or problems.suites():
        drawn = sheet(suite, args.first, args.columns)
        file = OUT / f"{suite}.jpg"
        write_atomically(file, iio.imwrite("<bytes>", np.asarray(drawn), extension=".jpg", quality=85))
        print(file)


if __name__ == "__main__":
    run_script(main)
