"""YAML files validated by pydantic: reading, errors in one sentence, and serialization."""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Hashable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar, dataclass_transform, get_args, get_origin

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, PrivateAttr, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from apex_ompl.errors import FileFormatError, nearest_name
from apex_ompl.util.arrays import is_masked_array
from apex_ompl.util.display import counted, values_line
from apex_ompl.util.files import read_text
from apex_ompl.util.forking import ProcessLock, unforked

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


HIDDEN = {
    "model_config",
    "model_json_schema",
    "model_post_init",
    "model_rebuild",
    "model_validate",
    "model_validate_json",
}
NUMBERS = re.compile(r"\[[-+.\deE,\s]*\]")  # vectors in flow style: a level each, and most of the brackets

ModelT = TypeVar("ModelT", bound="StrictModel")

_building = ProcessLock()


class _Text(str):
    """Text that ``repr`` gives without quotes, as signatures print annotations."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


class _WithoutChecks(ast.NodeTransformer):
    """Replaces ``Annotated[KIND, CHECK]`` by ``KIND``."""

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        """Return the first part of an annotated type."""
        self.generic_visit(node)
        if isinstance(node.value, ast.Name) and node.value.id == "Annotated" and isinstance(node.slice, ast.Tuple):
            return node.slice.elts[0]
        return node


@dataclass_transform(kw_only_default=True, field_specifiers=(Field, PrivateAttr))  # as pydantic's, for type checkers
class RecordType(ModelMetaclass):
    """Class of record classes: ``dir`` lists what they add to pydantic's, the signature has their fields.

    ``pydoc`` shows what ``dir`` lists. Records themselves are as pydantic makes them, ``dir`` of them included.
    """

    def __dir__(cls) -> list[str]:
        """Return the public names that the record and its bases define up to pydantic's."""
        bases = cls.__mro__[: cls.__mro__.index(BaseModel)] if BaseModel in cls.__mro__ else cls.__mro__
        names = {name for base in bases for name in vars(base) if not name.startswith("_")}
        return sorted(names - HIDDEN)

    @property
    def __signature__(cls) -> inspect.Signature:
        """Signature of the class: its fields as keywords, with types as they are written in the source."""
        written: dict[str, Any] = {}
        for base in reversed(cls.__mro__):
            written |= inspect.get_annotations(base)
        parameters = []
        for name, field in cls.model_fields.items():  # type: ignore[attr-defined]
            default = inspect.Parameter.empty if field.is_required() else field.get_default(call_default_factory=True)
            kind, annotation = inspect.Parameter.KEYWORD_ONLY, _annotation(written.get(name))
            parameters.append(inspect.Parameter(field.alias or name, kind, annotation=annotation, default=default))
        return inspect.Signature(parameters)

    @__signature__.setter
    def __signature__(cls, value: object) -> None:
        """Leave it: pydantic sets one with all of its checks when it builds what validates a record."""


def _annotation(written: Any) -> Any:
    """Return an annotation for a signature, without checks and without quotes."""
    if not isinstance(written, str):
        return inspect.Parameter.empty if written is None else written
    return _Text(ast.unparse(_WithoutChecks().visit(ast.parse(written, mode="eval"))))


def _number(value: Any) -> Any:
    """Return what may become a number; pydantic alone takes texts and True for numbers, too."""
    if isinstance(value, (str, bytes, bool, np.bool_)) or is_masked_array(value):
        raise ValueError("expected a number")
    return value


def _strict(schema: Any) -> Any:
    """Return a core schema of pydantic with strict numbers and truth values."""
    if isinstance(schema, list):
        return [_strict(inner) for inner in schema]
    if not isinstance(schema, dict):
        return tuple(map(_strict, schema)) if isinstance(schema, tuple) else schema
    kind = schema.get("type")
    if kind == "function-before" and schema["function"]["function"] is _number:  # of another record
        return schema
    if kind == "bool":
        return schema | {"strict": True}
    if kind in ("float", "int"):
        return core_schema.no_info_before_validator_function(_number, schema)
    return {key: inner if key in ("metadata", "config") else _strict(inner) for key, inner in schema.items()}


class StrictModel(BaseModel, metaclass=RecordType):
    """A frozen record without unknown keys and with finite numbers only.

    Numbers must be numbers, neither texts nor True or False, and what is true or false must be given as such. Made from
    faulty values it raises a FileFormatError with the first fault, which names the class, the field, the value and what
    was expected; pydantic's ValidationError is its cause.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True, validate_default=True,
        defer_build=True,
    )  # fmt: skip

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of the record with strict numbers and truth values, wherever they stand in its fields."""
        found: CoreSchema = _strict(handler(source))
        return found

    @classmethod
    def model_rebuild(cls, *, _parent_namespace_depth: int = 2, **options: Any) -> bool | None:
        """Build what validates the record, which waits for its first use: one thread at a time, while none forks."""
        with unforked(), _building:
            return super().model_rebuild(_parent_namespace_depth=_parent_namespace_depth + 1, **options)

    @classmethod
    def model_json_schema(cls, *args: Any, **options: Any) -> dict[str, Any]:
        """Return the JSON schema of the record, one thread at a time, while none forks: pydantic may still import."""
        with unforked(), _building:
            return super().model_json_schema(*args, **options)

    def __init__(self, /, **data: Any) -> None:
        """Make a record from its fields.

        Raises:
            FileFormatError: A field is unknown, missing or faulty.
        """
        with _first_fault(type(self), type(self).__name__):
            super().__init__(**data)

    # pydantic makes records inside of others without __init__, unless it takes it for one that does more than its own
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @classmethod
    def model_validate(cls, obj: Any, **options: Any) -> Self:
        """Make a record from plain data.

        Raises:
            FileFormatError: A field is unknown, missing or faulty.
        """
        with _first_fault(cls, cls.__name__):
            return super().model_validate(obj, **options)

    @classmethod
    def model_validate_json(cls, json_data: str | bytes | bytearray, **options: Any) -> Self:
        """Make a record from JSON.

        Raises:
            FileFormatError: It is not JSON, or a field is unknown, missing or faulty.
        """
        with _first_fault(cls, cls.__name__):
            return super().model_validate_json(json_data, **options)

    def __repr__(self) -> str:
        """Return one line with the fields that are not their defaults."""
        kinds = type(self).model_fields
        defaults = {
            name: one.get_default(call_default_factory=True) for name, one in kinds.items() if not one.is_required()
        }
        return values_line(type(self).__name__, dict(self), defaults)

    def __str__(self) -> str:
        """Return the same line."""
        return repr(self)

    if not TYPE_CHECKING:  # which knows that records are frozen

        def __setattr__(self, name: str, value: Any) -> None:
            """Set a private attribute.

            Raises:
                FileFormatError: The attribute is a field.
            """
            with _first_fault(type(self), type(self).__name__):
                super().__setattr__(name, value)


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses duplicate keys."""


class _FastLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The same by libyaml, ten times faster; deep nesting crashes the process."""


def _shallow(text: str) -> bool:
    """Whether a bound on the nesting depth of YAML text is at most about a hundred levels."""
    text = NUMBERS.sub("0", text)
    text = re.sub(r"(?m)^\s*#.*$", "", text)
    text = re.sub(r"""(?<=[:,] )("[^"\\\n]*"|'[^'\n]*')""", "", text)  # values that are quoted on one line
    quoted = "'" in text or '"' in text  # closing brackets may be part of text then
    depth = deepest = 0
    for bracket in re.findall(r"[\[{\]}]", text if quoted else re.sub(r"(?m)(^|\s)#.*$", "", text)):
        depth = depth + 1 if bracket in "[{" else max(0, depth - (not quoted))
        deepest = max(deepest, depth)
    return deepest < 100 and not re.search(r"^[\s?:-]{200}", text, re.MULTILINE)


def _mapping(loader: _Loader | _FastLoader, node: yaml.MappingNode) -> dict[Hashable, Any]:
    seen = set()
    for key_node, _ in node.value:
        if key_node.tag == "tag:yaml.org,2002:merge":
            continue
        key = loader.construct_object(key_node)
        if key in seen:
            raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is given twice", key_node.start_mark)
        seen.add(key)
    mapping: dict[Hashable, Any] = loader.construct_mapping(node, deep=True)  # merge keys are resolved
    return mapping


# PyYAML reads 1e-3 as text, YAML 1.2 as a number.
for _loader in (_Loader, _FastLoader):
    _loader.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
    )
    _loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def read_yaml(path: Path, role: str) -> dict[str, Any]:
    """Read a YAML mapping.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is not YAML, or not a mapping.
    """
    return parse_yaml(read_text(path, role), str(path))


def read_json(path: Path, role: str) -> dict[str, Any]:
    """Read a JSON object; much faster than :func:`read_yaml` where it is long.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is not JSON, or not an object.
    """
    try:
        data = json.loads(read_text(path, role))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(str(path), "", str(error), "expected JSON") from error
    if not isinstance(data, dict):
        raise FileFormatError(str(path), "", type(data).__name__, "expected a mapping of keys to values")
    return data


def check_version(data: Mapping[str, Any], schema: str, source: object) -> None:
    """Check that the content of a file names the version ``schema`` of its format; ``source`` is the file, for errors.

    Raises:
        FileFormatError: It names another one, or none.
    """
    if data.get("schema") != schema:
        raise FileFormatError(str(source), "schema", data.get("schema"), f"expected {schema!r}")


def read_record(path: Path, kind: type[ModelT], role: str) -> ModelT:
    """Read a JSON file as a record, whose field ``schema_`` has the only version that is read.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is not JSON, of another version, or does not follow the schema.
    """
    data = read_json(path, role)
    (schema,) = get_args(kind.model_fields["schema_"].annotation)
    check_version(data, schema, path)
    return validate(kind, data, str(path))


def yaml_value(text: str) -> Any:
    """Return the value that YAML text stands for, as files of this package are read.

    Raises:
        YAMLError: It does not parse.
    """
    return yaml.load(text, Loader=_loader_of(text))


def _loader_of(text: str) -> type[_Loader | _FastLoader]:
    return _FastLoader if _shallow(text) else _Loader


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Parse YAML text that holds one mapping; ``source`` names it in errors.

    Documents without content do not count, such as that after the ``---`` at the end of what ROS's tools print.

    Raises:
        FileFormatError: It does not parse, or is not a mapping.
    """
    try:
        documents = list(yaml.load_all(text, Loader=_loader_of(text)))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = str(error.problem or error.context).strip()
        raise FileFormatError(source, place, problem, "expected valid YAML") from error
    except Exception as error:  # PyYAML raises many kinds, deep nesting a RecursionError
        what = str(error) or type(error).__name__
        raise FileFormatError(source, "", what, "expected valid YAML") from error
    given = [one for one in documents if one is not None] or [None]
    if len(given) > 1:
        raise FileFormatError(source, "", f"{len(given)} of them", "expected one document of YAML")
    data = given[0]
    if not isinstance(data, dict):
        raise FileFormatError(source, "", data, "expected a mapping of keys to values")
    return data


def validate(model: type[ModelT], data: dict[str, Any], source: str, context: Any = None) -> ModelT:
    """Return a record made from ``data``; the error describes the first fault in one sentence.

    Args:
        model: The class of the record.
        data: Its fields.
        source: The file, for errors.
        context: What validators of the class need besides.

    Raises:
        FileFormatError: ``data`` does not fit ``model``.
    """
    with _first_fault(model, source):
        return super(StrictModel, model).model_validate(data, context=context)


@contextmanager
def _first_fault(model: type[BaseModel], source: str) -> Iterator[None]:
    """Say what is wrong first with the values of a record that is made in a block, in one sentence.

    Raises:
        FileFormatError: pydantic found a fault.
    """
    try:
        yield
    except ValidationError as error:
        faults = error.errors()
        # A misspelt key is reported as a missing key too; the misspelling is more informative.
        first = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
        location, _ = _without_tags(model, first["loc"])
        expected = first["msg"][0].lower() + first["msg"][1:]
        value = first["input"]
        if first["type"] == "extra_forbidden":
            known = _keys(_without_tags(model, first["loc"][:-1])[1])
            near = nearest_name(location[-1], known)
            hint = f"did you mean {near!r}?" if near else f"known: {', '.join(sorted(known))}"
            expected, value = f"unknown key, {hint}", location[-1]
        elif first["type"] == "missing":
            expected, value = "required key is missing", sorted(map(str, value)) if value else value
        elif first["type"] == "union_tag_not_found":
            location.append(first["ctx"]["discriminator"].strip("'"))
            expected, value = "required key is missing", sorted(map(str, value))
        elif first["type"] == "union_tag_invalid":
            location.append(first["ctx"]["discriminator"].strip("'"))
            expected, value = f"expected one of {first['ctx']['expected_tags']}", first["ctx"]["tag"]
        elif first["type"] == "value_error":
            expected = str(first["ctx"]["error"])
        elif first["type"] in ("too_short", "too_long"):
            most = first["type"] == "too_long"
            number = first["ctx"]["max_length" if most else "min_length"]
            expected = f"expected {counted(number, 'item')} or {'fewer' if most else 'more'}"
        elif first["type"] == "tuple_type":
            expected = "expected a list"
        elif first["type"] in ("dict_type", "model_type", "model_attributes_type"):
            expected = "expected a mapping of keys to values"
        elif first["type"] == "bool_type":
            expected = "expected true or false"
        elif first["type"] == "frozen_instance":
            expected = "records do not change, expected a new one as by model_copy(update={...})"
        field = ".".join(location) if location else ""
        raise FileFormatError(source, field, value, expected) from error


def replaced(data: dict[str, Any], changes: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return ``data`` with some keys replaced in place: ``changes`` maps dotted keys such as ``latent.dim`` to values.

    Raises:
        FileFormatError: A key goes through something that holds no keys.
    """
    for key, value in changes.items():
        *above, last = key.split(".")
        section = data
        for name in above:
            section = section.setdefault(name, {})
            if not isinstance(section, dict):
                raise FileFormatError(source, key, value, f"expected {name!r} to hold keys")
        section[last] = value
    return data


def _without_tags(
    model: type[BaseModel], location: tuple[int | str, ...]
) -> tuple[list[str], type[BaseModel] | None]:  # fmt: skip
    """Return pydantic's location inside ``model`` without the tags of unions, and the kind of record there, if any."""
    path: list[str] = []
    current: type[BaseModel] | None = model
    free_key = False  # the next part is the key of a mapping, not a field
    tagged: dict[str, type[BaseModel]] = {}
    for part in location:
        if isinstance(part, str) and part in tagged:
            current, tagged = tagged[part], {}
            continue
        path.append(str(part))
        if isinstance(part, int) or current is None or free_key:
            free_key = False
            continue
        field = next((f for n, f in current.model_fields.items() if part in (n, f.alias)), None)
        tagged = _tagged(field.annotation) if field else {}
        current = _model_in(field.annotation) if field and not tagged else None
        free_key = field is not None and get_origin(field.annotation) is dict
    return path, current


def _keys(model: type[BaseModel] | None) -> set[str]:
    """Return the keys that a record accepts."""
    return {field.alias or name for name, field in model.model_fields.items()} if model else set()


def _tagged(annotation: Any) -> dict[str, type[BaseModel]]:
    """Return tag -> record type of a union with a discriminator inside an annotation; empty where there is none."""
    inside = get_args(annotation)
    for mark in inside[1:]:
        if isinstance(mark, FieldInfo) and isinstance(mark.discriminator, str):
            kinds = get_args(inside[0])
            return {tag: kind for kind in kinds for tag in get_args(kind.model_fields[mark.discriminator].annotation)}
    return next((found for inner in inside if (found := _tagged(inner))), {})


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the record type inside an annotation such as ``tuple[Obstacle, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in get_args(annotation):
        found = _model_in(inner)
        if found is not None:
            return found
    return None


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Block style for mappings, flow style for vectors of numbers; by libyaml where it is there."""


def _represent_sequence(dumper: _Dumper, data: Any) -> yaml.SequenceNode:
    flat = all(v is None or isinstance(v, (int, float)) for v in data)
    node: yaml.SequenceNode = dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)
    return node


_Dumper.add_representer(list, _represent_sequence)
_Dumper.add_representer(tuple, _represent_sequence)


def dump_yaml(data: dict[str, Any]) -> str:
    """Return YAML text with keys in the order given."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=110, allow_unicode=True)
