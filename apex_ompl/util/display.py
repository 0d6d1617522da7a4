"""How objects and work show themselves: a line at a prompt, a summary, a table in a notebook, a progress bar."""

from __future__ import annotations

import reprlib
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any, NamedTuple, TypeVar

WIDTH = 119  # of one line [characters]
LABEL = 10  # width of the labels of a summary
T = TypeVar("T")


def one_line(kind: str, *parts: str) -> str:
    """Return ``KIND(PART, PART)`` without line breaks, cut to ``WIDTH``; empty parts are left out."""
    text = " ".join(", ".join(part for part in parts if part).split())
    room = WIDTH - len(kind) - 2
    return f"{kind}({text if len(text) <= room else text[: room - 3] + '...'})"


def counted(number: int, noun: str) -> str:
    """Return a number of objects in words: ``1 obstacle``, ``3 obstacles``."""
    return f"{number} {noun}" + "s" * (number != 1)


class _Short(reprlib.Repr):
    """``repr`` that gives the shape of an array in place of its numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = self.maxlong = 2 * WIDTH  # the line is cut as a whole
        self.maxtuple = self.maxlist = self.maxdict = 20

    def repr_ndarray(self, array: Any, _level: int) -> str:
        """Return the shape of an array; ``reprlib`` finds this method by the name of the type."""
        return f"array {array.shape}"

    repr_Tensor = repr_ndarray


_short = _Short()


def fields_line(record: Any) -> str:
    """Return one line about a dataclass or a named tuple: its fields other than their defaults, arrays by shape.

    A dataclass takes it by ``__repr__ = fields_line``.
    """
    if isinstance(record, tuple):
        shown = record._asdict()  # type: ignore[attr-defined]
        return values_line(type(record).__name__, shown, record._field_defaults)  # type: ignore[attr-defined]
    known = [field for field in fields(record) if field.repr]
    defaults = {
        field.name: field.default if field.default_factory is MISSING else field.default_factory()
        for field in known
        if not (field.default is MISSING and field.default_factory is MISSING)
    }
    return values_line(type(record).__name__, {field.name: getattr(record, field.name) for field in known}, defaults)


def values_line(kind: str, values: Mapping[str, Any], defaults: Mapping[str, Any]) -> str:
    """Return one line about named values, without those that are their defaults."""
    shown = {name: _short.repr(value) for name, value in values.items()}
    usual = {name: _short.repr(value) for name, value in defaults.items()}
    return one_line(kind, *(f"{name}={text}" for name, text in shown.items() if usual.get(name) != text))


class Summary(NamedTuple):
    """Some lines about a result.

    Attributes:
        title: The first line.
        rows: Label and text of each other line.
    """

    title: str
    rows: Sequence[tuple[str, str]]

    def __str__(self) -> str:
        """Return the lines as the command line prints them."""
        return "\n".join([self.title, *(f"  {label:<{LABEL}} {text}" for label, text in self.rows)])

    @property
    def html(self) -> str:
        """The lines as a table of HTML."""
        return html_table(self.title, self.rows)


def html_table(title: str, rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Return a table of HTML for notebooks; all text is escaped.

    Args:
        title: Text above the table.
        rows: Texts of the cells.
        head: Titles of the columns; without them the first cell of a row is its label.
    """
    from html import escape

    def line(cells: Sequence[str], tags: Sequence[str]) -> str:
        inner = "".join(
            f'<{tag} style="text-align: left">{escape(cell)}</{tag}>' for cell, tag in zip(cells, tags, strict=True)
        )
        return f"<tr>{inner}</tr>"

    lines = [line(head, ["th"] * len(head))] if head else []
    lines += [line(row, ["th"] * (not head) + ["td"] * (len(row) - (not head))) for row in rows]
    caption = f'<caption style="text-align: left"><b>{escape(title)}</b></caption>'
    return f"<table>{caption}{''.join(lines)}</table>"


def progress(items: Sequence[T], what: str, after: float) -> Iterator[T]:
    """Yield items, and show on a terminal how many are done when they take long.

    Args:
        items: The items.
        what: Their name.
        after: How long they may take until the bar is shown [s].
    """
    bar, started = None, time.monotonic()
    try:
        for done, item in enumerate(items):
            if bar is None and time.monotonic() - started > after:
                from tqdm import tqdm  # takes longer to import than most items

                bar = tqdm(total=len(items), initial=done, desc=what, leave=False, disable=None)
            yield item
            if bar is not None:
                bar.update()
    finally:
        if bar is not None:
            bar.close()
