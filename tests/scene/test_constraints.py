"""Constraints in problem files: round trips, the exported schema, and one sentence for each fault."""

from __future__ import annotations

import json
import math
import pickle
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl.errors import FileFormatError
from apex_ompl.scene import (
    AttachedObject,
    FixedOrientation,
    Goal,
    OnLine,
    OnPlane,
    Pose,
    PoseTolerance,
    Problem,
    RelativePose,
    ToolRegion,
    Upright,
)
from apex_ompl.scene.constraints import LEAST_WIDTH, Constraint
from apex_ompl.util.schema import parse_yaml

FILE = """schema: apex-ompl/problem/1
name: tray
robot: some_robot
attached:
  - {name: tray, links: [left_palm, right_palm], box: [0.3, 0.5, 0.02], position: [0, 0, 0.1]}
start: {a: 0.1}
goal: {joints: {a: 1}}
constraints:
  - {kind: upright, frame: tray, angle: 0.05}
  - {kind: relative_pose, first: left_palm, second: right_palm, free: [x, rz], tolerance: {position: 0.002}}
  - {kind: on_plane, frame: left_hand, normal: [0, 0, 1], point: [0, 0, 0.3]}
  - {kind: on_line, frame: left_hand, direction: [1, 0, 0]}
  - {kind: fixed_orientation, frame: left_hand, orientation: [0, 0, 0, 1]}
  - {kind: tool_region, frame: left_hand, lower: [null, -0.1, 0], upper: [null, 0.1, .inf], angle: 0.5}
"""


def base(**fields: Any) -> Problem:
    return Problem(name="p", robot="r", start={"a": 0.0}, goal=Goal(joints=({"a": 1.0},)), **fields)


def test_a_file_has_every_kind(tmp_path: Path) -> None:
    problem = Problem.parse(parse_yaml(FILE, "file"), "file")
    assert problem.constraints == (
        Upright(frame="tray", angle=0.05),
        RelativePose(first="left_palm", second="right_palm", free=("x", "rz"), tolerance=PoseTolerance(position=0.002)),
        OnPlane(frame="left_hand", normal=(0, 0, 1), point=(0, 0, 0.3)),
        OnLine(frame="left_hand", direction=(1, 0, 0)),
        FixedOrientation(frame="left_hand", orientation=(0, 0, 0, 1)),
        ToolRegion(frame="left_hand", lower=(None, -0.1, 0), upper=(None, 0.1, None), angle=0.5),
    )
    assert problem.attached[0].link == "left_palm" and problem.attached[0].holders == ("left_palm", "right_palm")
    problem.save(tmp_path / "again.yaml")
    assert Problem.load(tmp_path / "again.yaml") == problem
    assert "lower: [null, -0.1, 0.0]" in problem.to_yaml()
    assert pickle.loads(pickle.dumps(problem)) == problem


def test_the_exported_schema_tells_kinds_apart() -> None:
    schema = json.loads(json.dumps(Problem.model_json_schema(by_alias=True)))
    jsonschema.Draft202012Validator.check_schema(schema)
    data = parse_yaml(FILE.replace(".inf", "null"), "file")
    jsonschema.validate(data, schema)
    jsonschema.validate(json.loads(json.dumps(Problem.parse(data, "file").as_dict())), schema)
    for change in ({"kind": "downright"}, {"angel": 1.0}, {"axis": [0, 0]}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**data, "constraints": [{**data["constraints"][0], **change}]}, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**data, "constraints": [{"frame": "tray"}]}, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**data, "attached": [{"name": "tray", "box": [1, 1, 1]}]}, schema)


def test_problems_without_constraints_have_none_in_their_files() -> None:
    assert base().constraints == () and "constraints" not in base().as_dict()
    assert Problem.parse(parse_yaml(FILE.partition("constraints:")[0] + "constraints:\n", "f"), "f").constraints == ()


numbers = st.floats(-10, 10, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers)
directions = vectors.filter(lambda v: math.hypot(*v) > 1e-3)
quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(one / math.hypot(*q) for one in q))
)
angles = st.floats(1e-3, 3.0)
frames = st.sampled_from(["left_hand", "cup", "a/b.c-d"])
free = st.tuples(
    st.sets(st.sampled_from("xyz")), st.sampled_from([(), ("rx",), ("ry",), ("rz",), ("rx", "ry", "rz")])
).map(lambda pair: (*sorted(pair[0]), *pair[1])).filter(lambda found: len(found) < 6)  # fmt: skip
bounds = st.tuples(*[st.tuples(st.none() | st.floats(-5, 0), st.none() | st.floats(1, 5))] * 3)
kinds = st.one_of(
    st.builds(Upright, frame=frames, axis=directions, up=directions, angle=angles),
    st.builds(
        RelativePose,
        first=st.just("world"),
        second=frames,
        pose=st.none() | st.builds(Pose, position=vectors, orientation=quaternions),
        free=free,
        tolerance=st.builds(PoseTolerance, position=angles, angle=angles),
    ),
    st.builds(OnPlane, frame=frames, normal=directions, point=st.none() | vectors, tolerance=angles),
    st.builds(OnLine, frame=frames, direction=directions, point=st.none() | vectors, tolerance=angles),
    st.builds(FixedOrientation, frame=frames, orientation=st.none() | quaternions, angle=angles),
    st.builds(
        lambda frame, given, place, turn, angle: ToolRegion(
            frame=frame,
            lower=tuple(-math.inf if low is None else low for low, _ in given),
            upper=tuple(math.inf if high is None else high for _, high in given),
            position=place,
            orientation=turn,
            angle=angle,
        ),
        frames, bounds, vectors, quaternions, angles,
    ),
)  # fmt: skip


@settings(max_examples=100)
@given(st.lists(kinds, max_size=4))
def test_any_constraints_survive_their_file(constraints: list[Constraint]) -> None:
    problem = base(constraints=tuple(constraints))
    again = Problem.parse(parse_yaml(problem.to_yaml(), "file"), "file")
    assert again == problem
    assert [type(one) for one in again.constraints] == [type(one) for one in constraints]


def test_infinite_bounds_are_no_bounds() -> None:
    given = ToolRegion(frame="a", lower=(-math.inf, 0.0, -math.inf), upper=(math.inf, math.inf, 1.0))
    assert (given.lower, given.upper) == ((None, 0.0, None), (None, None, 1.0))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("upright, frame", "uprigth, frame", "constraints.0.kind: expected one of 'upright', 'relative_pose', "),
        ("kind: upright, ", "", "constraints.0.kind: required key is missing, got ['angle', 'frame']"),
        ("frame: tray, angle", "angle", "constraints.0.frame: required key is missing"),
        ("angle: 0.05", "angel: 0.05", "constraints.0.angel: unknown key, did you mean 'angle'?"),
        ("angle: 0.05", "angle: 0", "constraints.0.angle: input should be greater than 0, got 0"),
        ("angle: 0.05", "angle: 3.2", "constraints.0.angle: input should be less than or equal to 3.14"),
        ("angle: 0.05", "angle: .nan", "constraints.0.angle: input should be a finite number"),
        ("angle: 0.05", "axis: [0, 0, 0]", "constraints.0.axis: expected a direction that is not zero"),
        ("angle: 0.05", "up: [0, 0, 0]", "constraints.0.up: expected a direction that is not zero"),
        ("normal: [0, 0, 1]", "normal: [0, 0, 0]", "constraints.2.normal: expected a direction that is not zero"),
        ("direction: [1, 0, 0]", "direction: [0, 0, 0]", "constraints.3.direction: expected a direction"),
        ("point: [0, 0, 0.3]", "tolerance: 0", "constraints.2.tolerance: input should be greater than 0"),
        ("second: right_palm", "second: left_palm", "constraints.1: first and second are the same"),
        ("second: right_palm", "second: world", "constraints.1: expected a frame of the robot as second; first may"),
        ("free: [x, rz]", "free: [x, q]", "constraints.1.free.1: input should be 'x', 'y', 'z', 'rx', 'ry' or 'rz'"),
        ("free: [x, rz]", "free: [x, x]", "constraints.1.free: 'x' is given twice"),
        ("free: [x, rz]", "free: [rx, rz]", "constraints.1.free: expected none, one or all of rx, ry, rz"),
        ("free: [x, rz]", "free: [x, y, z, rx, ry, rz]", "constraints.1.free: expected at least one of x, y, z, rx"),
        ("position: 0.002", "positon: 0.1", "constraints.1.tolerance.positon: unknown key, did you mean 'position'?"),
        ("orientation: [0, 0, 0, 1]", "orientation: [0, 0, 0, 2]", "constraints.4.orientation: expected a unit quat"),
        ("lower: [null, -0.1, 0]", "lower: [null, 0.2, 0]", "constraints.5: expected a lower bound that is at most"),
        ("lower: [null, -0.1, 0]", "lower: [null, 0.0999, 0]", f"expected bounds of y that are at least {LEAST_WIDTH}"),
        ("lower: [null, -0.1, 0]", "lower: [.inf, -0.1, 0]", "constraints.5.lower.0: input should be a finite number"),
        ("lower: [null, -0.1, 0]", "lower: [null, -0.1]", "constraints.5.lower.2: required key is missing"),
        (
            "lower: [null, -0.1, 0], upper: [null, 0.1, .inf], angle: 0.5",
            "lower: [null, null, null]",
            "constraints.5: expected a bound or an angle",
        ),
        ("links: [left_palm, right_palm]", "links: [left_palm, left_palm]", "attached.0: 'tray': expected two links"),
        ("links: [left_palm, right_palm]", "links: [left_palm]", "attached.0.links.1: required key is missing"),
        ("links: [left", "link: right_palm, links: [left", "expected 'right_palm', the link, as the first of links"),
        ("links: [left", "touch_links: [left_palm], links: [left", "expected 'right_palm', which holds it, among"),
        ("links: [left_palm, right_palm], ", "", "attached.0.link: required key is missing"),
    ],
)  # fmt: skip
def test_each_fault_is_one_sentence_that_names_it(old: str, new: str, sentence: str) -> None:
    assert old in FILE
    with pytest.raises(FileFormatError) as caught:
        Problem.parse(parse_yaml(FILE.replace(old, new), "file"), "file")
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_an_object_that_one_link_holds_is_as_before() -> None:
    held = AttachedObject(name="cup", link="palm", sphere={"radius": 0.1})
    assert held.links is None and held.holders == ("palm",)
    assert base(attached=(held,)).as_dict()["attached"] == ({"name": "cup", "sphere": {"radius": 0.1}, "link": "palm"},)
