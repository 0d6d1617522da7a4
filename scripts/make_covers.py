"""Make the sphere covers of all link shapes of a robot, prove them, and write them to a file.

Prints per shape the balls of each level (the root first, leaves last), the volume of the leaves relative to the
solid, and how far the surface of the leaves is from the solid. With ``--tolerances`` it writes nothing, and prints
how many leaves each gap takes instead.

The file is the one that the robot's file names as ``covers``; without one, NAME.spheres.json beside it.

Usage: python scripts/make_covers.py dual_panda_softhand [--gaps 0.02 0.007 0.0025] [-o FILE]
       python scripts/make_covers.py my.robot.yaml    (name the file as ``covers`` in it then)
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import coal
import numpy as np

from apex_ompl.collision.cover.spheres import GAPS, Cover, make_cover, quality, shape_key, unproved, write_covers
from apex_ompl.robot import Robot
from apex_ompl.robot.model import bare_robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import check_writable


def shapes_of(robot: Robot) -> dict[str, tuple[list[str], coal.CollisionGeometry]]:
    """Return shape key -> names of the links' geometry objects with that shape, and the shape."""
    shapes: dict[str, tuple[list[str], coal.CollisionGeometry]] = {}
    for item in robot.geometry.geometryObjects:
        shapes.setdefault(shape_key(item.geometry), ([], item.geometry))[0].append(item.name)
    return shapes


def row(name: str, geometry: coal.CollisionGeometry, cover: Cover, seconds: float) -> str:
    """Return one row of the table."""
    left = len(unproved(geometry, cover))
    ratio, mean, largest = quality(geometry, cover, np.random.default_rng(0))
    levels = " ".join(str(n) for n in np.bincount(cover.levels))
    proved = "" if left == 0 else f"  NOT PROVED: {left} boxes"
    numbers = f"{len(cover.leaves):6d}  {ratio:7.2f}  {mean * 1e3:7.1f}  {largest * 1e3:7.1f}  {seconds:7.2f}"
    return f"{name:44s} {levels:12s} {numbers}{proved}"


def main() -> None:
    """Make and write the covers of one robot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", help="name of a shipped robot, or a robot file")
    parser.add_argument("--gaps", type=float, nargs="+", default=list(GAPS), help="gaps of the levels, descending [m]")
    parser.add_argument("--tolerances", type=float, nargs="+", help="only compare these gaps [m]")
    parser.add_argument("--only", default="", help="only shapes of links whose names contain this, with --tolerances")
    parser.add_argument("--effort", type=int, default=3, choices=(1, 2, 3), help="thoroughness of the search")
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    robot, config, path = bare_robot(args.robot)
    output = args.output or path.parent / (config.covers or f"{path.name.split('.')[0]}.spheres.json")
    if not args.tolerances:
        check_writable(output)
    covers = {}
    print(
        f"{'shape':44s} {'levels':12s} {'leaves':>6s}  {'volume':>6s}  {'mean mm':>7s}  {'max mm':>7s}  {'seconds':>7s}"
    )
    for key, (names, geometry) in shapes_of(robot).items():
        label = names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")
        if args.tolerances:
            for gap in args.tolerances if any(args.only in name for name in names) else ():
                start = time.perf_counter()
                cover = make_cover(geometry, (gap,), most=400, effort=args.effort)
                print(row(f"{gap * 1e3:4.0f} mm: {label}", geometry, cover, time.perf_counter() - start), flush=True)
            continue
        start = time.perf_counter()
        covers[key] = make_cover(geometry, args.gaps, effort=args.effort)
        print(row(label, geometry, covers[key], time.perf_counter() - start), flush=True)
    if covers:
        write_covers(output, covers)
        print(f"{len(covers)} covers, {sum(len(c.radii) for c in covers.values())} balls -> {output}")


if __name__ == "__main__":
    run_script(main)
