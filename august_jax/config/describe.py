"""Every field of a configuration as a record, for the help and the documentation."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, get_args, get_origin

from august_jax.config import schema
from august_jax.config.fields import bounds_of, hints, parted


class Field(NamedTuple):
    """One field.

    Attributes:
        path: such as ``train.steps``.
        type: in words, or the choices.
        default: what it holds unless a preset or an override says otherwise.
        bounds: of its number or of each of its numbers; None where it has none.
        unit: of the bounds; empty for pure numbers.
        doc: what it means.
    """

    path: str
    type: str
    default: Any
    bounds: tuple[int | float, int | float] | None
    unit: str
    doc: str


def describe() -> list[Field]:
    """Every field, in the order in which a configuration holds them."""
    return [
        Field(
            "preset",
            _named(hints(schema.Config)["preset"]),
            schema.Config.preset,
            None,
            "",
            "The preset that it began as.",
        )
    ] + list(_sections())


def _sections() -> Iterator[Field]:
    for part in fields(schema.Config):
        kind = hints(schema.Config)[part.name]
        if not (isinstance(kind, type) and is_dataclass(kind)):
            continue
        docs = _docs(kind.__name__)
        for each in fields(kind):
            hint = hints(kind)[each.name]
            bounds = bounds_of(hint)
            yield Field(
                f"{part.name}.{each.name}",
                _named(hint),
                each.default,
                (bounds.low, bounds.high) if bounds else None,
                bounds.unit if bounds else "",
                docs.get(each.name, ""),
            )


def _named(hint: Any) -> str:
    base, _ = parted(hint)
    if get_origin(base) is Literal:
        return " | ".join(get_args(base))
    if get_origin(base) is tuple:
        items = get_args(base)
        nested = get_origin(parted(items[0])[0]) is tuple
        entries = f"lists of {_named(items[0])}" if nested else f"{_named(items[0])}s"
        return f"list of {entries}" if items[-1] is Ellipsis else f"{len(items)} {entries}"
    return {int: "whole number", float: "number", bool: "true or false", str: "text"}[base]


@cache
def _docs(kind: str) -> dict[str, str]:
    """Field -> the text below it, of one dataclass, from the source."""
    tree = ast.parse(inspect.getsource(schema))
    body = next(node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == kind)
    found = {}
    for line, below in zip(body, body[1:]):
        if (
            isinstance(line, ast.AnnAssign)
            and isinstance(line.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
        ):
            found[line.target.id] = " ".join(str(below.value.value).split())
    return found
