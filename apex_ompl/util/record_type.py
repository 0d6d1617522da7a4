"""What Python's ``help`` and ``dir`` tell of records: their own fields and methods, not the machinery of pydantic."""

from __future__ import annotations

import ast
import inspect
from typing import TYPE_CHECKING, Any, dataclass_transform

from pydantic import BaseModel, Field, PrivateAttr

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
