from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from apex_ompl import errors, load_problem, problems
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, MeshFile, Obstacle, pose_matrix
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.util import schema
from apex_ompl.util.schema import dump_yaml, parse_yaml, validate
from apex_ompl.util.validation import key_value

FILE = """schema: apex-ompl/problem/1
name: small
robot: some_robot
scene:
  - {name: post, box: [0.1, 0.1, 0.4], position: [0.5, 0.0, 0.2], orientation: [0, 0, 0, 1]}
  - {name: ball, sphere: {radius: 0.1}, position: [0.4, 0.6, 0.3], velocity: [0, -0.2, 0]}
attached:
  - {name: cup, link: left_hand_palm, cylinder: {radius: 0.035, length: 0.11}, position: [0, 0, 0.1],
     contact: {point: [0, 0, 0.05], axis: [0, 0, 1]}}
start: {a: 0.1, b: 1e-3}
goal: {joints: {a: 1, b: 2}}
"""


def load_text(folder: Path, text: str) -> Problem:
    path = folder / "p.yaml"
    path.write_text(text)
    return Problem.load(path)


def test_reading_gives_states_in_the_order_asked_for(tmp_path: Path) -> None:
    problem = load_text(tmp_path, FILE)
    np.testing.assert_array_equal(problem.start_state(["b", "a"]), [0.001, 0.1])
    np.testing.assert_array_equal(problem.goal_states(["a", "b"]), [[1.0, 2.0]])
    assert problem.moving == ("ball",)
    assert problem.scene[0].shape == "box" and problem.attached[0].contact is not None


def test_merge_keys_are_taken_in(tmp_path: Path) -> None:
    text = FILE.replace("start: {a: 0.1, b: 1e-3}", "start: &s {a: 0.1, b: 1e-3}").replace(
        "{a: 1, b: 2}", "{<<: *s, b: 2}"
    )
    assert load_text(tmp_path, text).goal_states(["a", "b"]).tolist() == [[0.1, 2.0]]


def test_several_goals(tmp_path: Path) -> None:
    problem = load_text(tmp_path, FILE.replace("{a: 1, b: 2}", "[{a: 1, b: 2}, {b: 4, a: 3}]"))
    np.testing.assert_array_equal(problem.goal_states(["a", "b"]), [[1.0, 2.0], [3.0, 4.0]])


def test_saving_and_loading_round_trips(tmp_path: Path) -> None:
    problem = load_text(tmp_path, FILE)
    problem.save(tmp_path / "again.yaml")
    assert Problem.load(tmp_path / "again.yaml") == problem
    for name in problems.names():
        load_problem(name).save(tmp_path / "again.yaml")
        assert Problem.load(tmp_path / "again.yaml") == load_problem(name)


numbers = st.floats(-10, 10, allow_nan=False)
sizes = st.floats(1e-3, 5)
vectors = st.tuples(numbers, numbers, numbers)
shapes = st.one_of(
    st.builds(lambda v: {"box": v}, st.tuples(sizes, sizes, sizes)),
    st.builds(lambda r: {"sphere": {"radius": r}}, sizes),
    st.builds(lambda r, n: {"cylinder": {"radius": r, "length": n}}, sizes, sizes),
    st.builds(lambda r, n: {"capsule": {"radius": r, "length": n}}, sizes, sizes),
    st.builds(lambda o: {"half_space": {"normal": (0.0, 1.0, 0.0), "offset": o}}, numbers),
)


@settings(max_examples=50)
@given(st.lists(st.tuples(shapes, vectors), max_size=4), st.lists(numbers, min_size=3, max_size=3))
def test_any_problem_survives_its_file(tmp_path_factory: pytest.TempPathFactory, scene: list, start: list) -> None:
    obstacles = tuple(Obstacle(name=f"o{k}", position=at, **shape) for k, (shape, at) in enumerate(scene))
    values = dict(zip("abc", start, strict=True))
    problem = Problem(name="any", robot="r", scene=obstacles, start=values, goal=Goal(joints=(values, values)))
    path = tmp_path_factory.mktemp("p") / "any.yaml"
    problem.save(path)
    assert Problem.load(path) == problem


def test_files_follow_the_exported_json_schema() -> None:
    schema = json.loads(json.dumps(Problem.model_json_schema(by_alias=True)))
    assert schema["properties"]["schema"]["const"] == "apex-ompl/problem/1"
    jsonschema.validate(parse_yaml(FILE, "file"), schema)
    broken = parse_yaml(FILE, "file")
    broken["scene"][0]["bx"] = 1
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(broken, schema)
    for name in problems.names():
        jsonschema.validate(parse_yaml((problems.DATA / f"{name}.yaml").read_text(), name), schema)


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_pose_matrix_is_scipys(q: list[float]) -> None:
    expected = Rotation.from_quat(q).as_matrix()
    np.testing.assert_allclose(pose_matrix((1, 2, 3), q)[:3, :3], expected, atol=1e-12)
    np.testing.assert_array_equal(pose_matrix((1, 2, 3), q)[:, 3], [1, 2, 3, 1])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("problem/1", "problem/9", ["schema", "'apex-ompl/problem/9'", "expected 'apex-ompl/problem/1'"]),
        ("schema: apex-ompl/problem/1\n", "", ["schema", "None", "expected 'apex-ompl/problem/1'"]),
        ("start: {a: 0.1,", "start: {a: [,", ["line 10", "valid YAML"]),
        ("box: [0.1, 0.1, 0.4]", "bx: [0.1, 0.1, 0.4]", ["scene.0.bx", "did you mean 'box'"]),
        ("robot: some_robot\n", "", ["robot", "required key is missing"]),
        ("robot: some_robot", "robots: some_robot", ["robot"]),
        ("a: 0.1", "a: .nan", ["start.a", "finite", "nan"]),
        ("a: 0.1", "a: .inf", ["start.a", "finite", "inf"]),
        ("a: 0.1", "a: fast", ["start.a", "number", "'fast'"]),
        ("a: 0.1", "a: yes", ["start.a", "number", "True"]),
        ("a: 0.1", "a: !!bool foo", ["valid YAML"]),
        ("a: 0.1", "a: " + "[" * 3000, ["valid YAML"]),
        ("position: [0.5, 0.0, 0.2]", "position: [1e300, 0.0, 0.2]", ["scene.0.position.0", "10000"]),
        ("{joints: {a: 1, b: 2}}", "{alignment: {kind: diagonal, first: cup, second: b}}", ["alignment.kind"]),
        ("goal: {joints: {a: 1, b: 2}}", "goal: {}", ["exactly one of joints, alignment"]),
        ("{joints: {a: 1, b: 2}}", "{alignment: {kind: vertical, first: cup, second: cup}}", ["the same"]),
        ("a: 0.1", "a: 0.1, a: 0.2", ["line 10", "'a' is given twice"]),
        ("[0.1, 0.1, 0.4]", "[0.1, 0.1]", ["scene.0.box"]),
        ("[0.1, 0.1, 0.4]", "[0.1, 0.1, -0.4]", ["scene.0.box.2", "greater than 0", "-0.4"]),
        ("orientation: [0, 0, 0, 1]", "orientation: [0, 0, 0, 2]", ["scene.0.orientation", "unit quaternion"]),
        ("sphere: {radius: 0.1}, ", "", ["ball", "exactly one of box", "none"]),
        ("sphere: {radius: 0.1}", "sphere: {radius: 0.1}, box: [1, 1, 1]", ["exactly one", "box and sphere"]),
        ("name: ball", "name: post", ["'post'", "more than one object"]),
        ("sphere: {radius: 0.1}", "mesh: {file: a.step}", ["scene.1.mesh.file", ".stl or .obj or .ply", "a.step"]),
        ("cylinder: {radius: 0.035, length: 0.11}", "half_space: {normal: [0, 0, 1]}", ["half_space cannot be held"]),
        ("axis: [0, 0, 1]", "axis: [0, 0, 0]", ["attached.0.contact.axis", "not zero"]),
        ("goal: {joints: {a: 1, b: 2}}", "goal: {joints: []}", ["goal.joints", "expected 1 item or more"]),
        ("goal: {joints: {a: 1, b: 2}}", "goal: {joint: {a: 1}}", ["goal.joint", "did you mean 'joints'"]),
    ],
)  # fmt: skip
def test_each_fault_is_one_sentence_that_names_it(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in FILE
    with pytest.raises(FileFormatError) as caught:
        load_text(tmp_path, FILE.replace(old, new, 1))
    message = str(caught.value)
    assert "\n" not in message and message.startswith(str(tmp_path / "p.yaml"))
    for word in words:
        assert word in message, message


def test_unknown_and_missing_joints_are_named(robot: Robot) -> None:
    joints = dict.fromkeys(robot.joint_names, 0.0)
    problem = Problem(name="p", robot=robot.name, start=joints, goal=Goal(joints=(joints, joints)))
    wrong = {"left_jiont3" if k == "left_joint3" else k: v for k, v in joints.items()}
    with pytest.raises(FileFormatError, match=r"p: start: unknown joint, did you mean 'left_joint3'"):
        problem.model_copy(update={"start": wrong}).start_state(robot.joint_names)
    del joints["right_joint7"]
    short = problem.model_copy(update={"goal": Goal(joints=(problem.start, joints))})
    with pytest.raises(FileFormatError, match=r"goal\.joints\.1: joint 'right_joint7' is missing"):
        short.goal_states(robot.joint_names)


def test_missing_and_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"problem file '.*gone.yaml': no such file"):
        Problem.load(tmp_path / "gone.yaml")
    with pytest.raises(MissingFileError, match="directory"):
        Problem.load(tmp_path)
    os.mkfifo(tmp_path / "pipe.yaml")
    for pipe in (tmp_path / "pipe.yaml", Path("/dev/zero")):
        with pytest.raises(MissingFileError, match="is a pipe or a device, expected a regular file"):
            Problem.load(pipe)
    for name in ("x\0y.yaml", "n" * 300 + ".yaml"):
        with pytest.raises(MissingFileError):
            Problem.load(tmp_path / name)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(FileFormatError, match="UTF-8"):
        Problem.load(tmp_path / "binary.yaml")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(FileFormatError, match="mapping"):
        Problem.load(tmp_path / "list.yaml")
    with pytest.raises(UnknownNameError, match="did you mean 'shelf_swap'"):
        load_problem("shelf_swpa")


def test_saving_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = load_text(tmp_path, FILE)
    with pytest.raises(MissingFileError, match="folder .* does not exist"):
        problem.save(tmp_path / "nowhere" / "p.yaml")
    target = tmp_path / "kept.yaml"
    target.write_text("before")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(ApexError, match="no space left"):
        problem.save(target)
    assert target.read_text() == "before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["kept.yaml", "p.yaml"]


def test_paths_of_meshes_and_robots_start_at_the_file(tmp_path: Path) -> None:
    folder = tmp_path / "deep"
    folder.mkdir()
    text = FILE.replace("sphere: {radius: 0.1}", "mesh: {file: ../bunny.stl}").replace("some_robot", "../r.yaml")
    problem = load_text(folder, text)
    assert problem.scene[1].mesh == MeshFile(file=str(tmp_path / "bunny.stl"))
    assert problem.robot == str(tmp_path / "r.yaml")


def test_a_held_half_space_is_refused_from_python_too() -> None:
    with pytest.raises(FileFormatError, match="cannot be held"):
        AttachedObject(name="floor", link="palm", half_space={"normal": (0.0, 0.0, 1.0)})


@pytest.mark.parametrize("levels", [50, 500, 50_000])
@pytest.mark.parametrize("opening", ["[", "{b: ", "- ", "- [\n", "? ", "[']', ", "[[1, 2], "])
def test_deep_nesting_is_a_fault_and_no_crash(levels: int, opening: str) -> None:
    with pytest.raises(FileFormatError):
        parse_yaml("a: " + opening * levels, "deep.yaml")


def test_vectors_beside_quotes_are_read_by_libyaml(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are not nested, however many there are; the slow reader takes half a minute for a saved result."""
    data = {"name": "it's", "vectors": [[k + 0.5, -1e-9, float(k)] for k in range(300)], "last": "a: b"}
    text = dump_yaml(data)
    assert "'" in text and text.count("[") == 300
    monkeypatch.setattr(schema, "_Loader", None)
    assert parse_yaml(text, "vectors.yaml") == data


@pytest.mark.parametrize(
    "error",
    [
        errors.UnknownNameError("planner", "rrt", ["a"]),
        errors.FileFormatError("file", "field", 1, "expected 2"),
        errors.MissingFileError("file", "role"),
        errors.ParameterError("seed", -1, "more"),
        errors.SceneError("said"),
    ],
)
def test_errors_pass_between_processes(error: errors.ApexError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error) and str(again) == str(error) and vars(again) == vars(error)


def test_faults_in_joint_names_name_the_file(problem: Problem, tmp_path: Path) -> None:
    file = tmp_path / "named.yaml"
    problem.save(file)
    loaded = Problem.load(file)
    assert loaded == problem and loaded.source == str(file)
    with pytest.raises(FileFormatError, match=r"named.yaml: start: joint 'elbow' is missing"):
        loaded.start_state([*problem.start, "elbow"])
    with pytest.raises(FileFormatError, match=r"named.yaml: goal.joints: joint 'elbow' is missing"):
        loaded.model_copy(update={"scene": ()}).goal_states([*problem.start, "elbow"])
    with pytest.raises(FileFormatError, match=f"^{problem.name}: start: "):
        problem.start_state(["elbow"])


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"box": ["0.1", 0.1, 0.1]}, r"box\.0: expected a number, got '0\.1'"),
        ({"box": [True, 0.1, 0.1]}, r"box\.0: expected a number, got True"),
        ({"sphere": {"radius": np.ma.masked}}, r"sphere\.radius: expected a number, got masked"),
        ({"sphere": {"radius": 1j}}, r"sphere\.radius: .*number, got 1j"),
        ({"mesh": {"file": "a.stl", "solid": "false"}}, r"mesh\.solid: expected true or false, got 'false'"),
        ({"mesh": {"file": "a.stl", "solid": 0}}, r"mesh\.solid: expected true or false, got 0"),
        ({"sphere": {"radius": 0.1}, "velocity": [0, "1", 0]}, r"velocity\.1: expected a number, got '1'"),
    ],
)
def test_texts_and_truth_values_are_no_numbers(fields: dict, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        validate(Obstacle, {"name": "o", **fields}, "obstacle")
    given = (np.float32(0.5), np.int64(1), 2)
    assert validate(Obstacle, {"name": "o", "box": given}, "obstacle").box == (0.5, 1.0, 2.0)


def test_documents_without_content_do_not_count() -> None:
    for text in ("a: 1\n---\n", "---\na: 1\n---\n---\n", "---\n---\na: 1\n...\n", "# nothing\n---\na: 1"):
        assert parse_yaml(text, "f.yaml") == {"a": 1}
    with pytest.raises(FileFormatError, match="f.yaml: expected one document of YAML, got '2 of them'"):
        parse_yaml("a: 1\n---\nb: 2\n", "f.yaml")
    with pytest.raises(FileFormatError, match="f.yaml: expected a mapping of keys to values, got None"):
        parse_yaml("---\n---\n", "f.yaml")


def test_values_on_a_command_line_are_read_as_in_files() -> None:
    assert key_value("rate=1e-3") == ("rate", 1e-3)
    assert key_value("name=on") == ("name", True) and key_value("name='1'") == ("name", "1")


def test_masses_of_objects_and_payloads_are_read_and_written(tmp_path: Path) -> None:
    text = FILE.replace("length: 0.11},", "length: 0.11}, mass: 0.4, center_of_mass: [0, 0, 0.01],")
    text = text.replace("attached:", "payload: {right_hand: 2}\nattached:")
    problem = load_text(tmp_path, text)
    assert problem.attached[0].mass == 0.4 and problem.attached[0].center_of_mass == (0.0, 0.0, 0.01)
    assert problem.payload == {"right_hand": 2.0}
    again = Problem.parse(problem.as_dict(), "again")
    assert again.attached == problem.attached and again.payload == problem.payload
    assert not {"payload", "mass", "inertia"} & {*load_text(tmp_path, FILE).to_yaml().split()}


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ("mass: 0", "attached.0.mass: input should be greater than 0, got 0"),
        ("mass: -1.5", "attached.0.mass: input should be greater than 0, got -1.5"),
        ("mass: .nan", "attached.0.mass: input should be"),
        ("mass: .inf", "attached.0.mass: input should be"),
        ("center_of_mass: [0, 0, 0]", "expected a mass beside center_of_mass and inertia"),
        ("mass: 1, inertia: [1, 0, 0, 1, 0]", "attached.0.inertia.5: required key is missing"),
        ("mass: 1, inertia: [1, 0, 0, 1, 0, 2.1]", "'cup': expected an inertia whose principal moments"),
        ("mass: 1, inertia: [1, 2, 0, 1, 0, 1]", "'cup': expected an inertia whose principal moments"),
        ("mass: 1, inertia: [.nan, 0, 0, 1, 0, 1]", "attached.0.inertia.0: input should be"),
    ],
)
def test_faulty_masses_are_named(tmp_path: Path, field: str, expected: str) -> None:
    with pytest.raises(FileFormatError, match=expected):
        load_text(tmp_path, FILE.replace("length: 0.11},", f"length: 0.11}}, {field},"))


@pytest.mark.parametrize("mass", ["0", "-1", ".nan", "heavy"])
def test_faulty_payloads_are_named(tmp_path: Path, mass: str) -> None:
    with pytest.raises(FileFormatError, match=r"payload.right_hand: (input should be|expected a number)"):
        load_text(tmp_path, f"{FILE}payload: {{right_hand: {mass}}}\n")


def test_half_spaces_have_no_mass() -> None:
    with pytest.raises(FileFormatError, match="'floor': expected no mass of a half_space"):
        Obstacle(name="floor", half_space={"normal": (0, 0, 1)}, mass=1.0)
