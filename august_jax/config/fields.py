"""What a field may hold: its type, and notes beside it that say what is wrong with a value.

A field is annotated as ``Annotated[int, within(1, 256)]``: the type says what the value becomes, each note what it must
obey. A note is a function of a value that returns a complaint, or nothing. The choices of a ``Literal`` stand in the
annotation and nowhere else.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Iterator, Sequence
from numbers import Real
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

Note = Callable[[Any], str | None]
"""Takes a value of the right type; what is wrong with it, or None."""


class ConfigError(ValueError):
    """A field of a configuration is unknown, or holds a value that cannot work."""


class Bounds(NamedTuple):
    """The least and the largest number that a field takes, both included; of a list, for each of its numbers.

    Attributes:
        low, high: the two ends.
        unit: of the numbers, for messages.
        why: the reason of an end that is not obvious.
    """

    low: int | float
    high: int | float
    unit: str = ""
    why: str = ""

    def __call__(self, value: Any) -> str | None:
        if all(self.low <= number <= self.high for number in _numbers(value)):
            return None
        return f"must lie in {self}"

    def __str__(self) -> str:
        return (
            f"{self.low:.10g} to {self.high:.10g}"
            + (f" {self.unit}" if self.unit else "")
            + (f" ({self.why})" if self.why else "")
        )


def within(low: int | float, high: int | float, unit: str = "", why: str = "") -> Bounds:
    """A note: numbers from ``low`` to ``high``, both included."""
    return Bounds(low, high, unit, why)


def rising(value: tuple[float, ...]) -> str | None:
    """A note: no number of a list is less than the one before."""
    return None if all(low <= high for low, high in zip(value, value[1:])) else "must not decrease"


def distinct(value: tuple[Any, ...]) -> str | None:
    """A note: no entry of a list is there twice."""
    twice = [each for row, each in enumerate(value) if each in value[:row]]
    return f"holds {twice[0]!r} twice; name each once" if twice else None


def filled(value: tuple[Any, ...]) -> str | None:
    """A note: a list with at least one entry."""
    return None if value else "is empty; name at least one"


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of a configuration, ``array`` for example, whose fields are checked when it is made.

    Numbers, lists and choices become what their annotation says (1 in a field of floats 1.0, a list a tuple), so that
    sections that say the same are equal and can be hashed.

    Raises:
        ConfigError: a value is not of its field's type, or a note complains.
    """

    def __post_init__(self) -> None:
        for name, hint in hints(type(self)).items():
            object.__setattr__(self, name, checked(hint, getattr(self, name), f"{self.section()}.{name}"))

    @classmethod
    def section(cls) -> str:
        """The section's name in a configuration."""
        return cls.__name__.removesuffix("Config").lower()


_HINTS: dict[type, dict[str, Any]] = {}


def hints(kind: type) -> dict[str, Any]:
    """Name -> annotation of the fields of a dataclass, notes included; worked out once."""
    if kind not in _HINTS:
        found = get_type_hints(kind, include_extras=True)
        _HINTS[kind] = {each.name: found[each.name] for each in dataclasses.fields(kind)}
    return _HINTS[kind]


def parted(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """An annotation's type and its notes."""
    if get_origin(hint) is Annotated:
        base, *notes = get_args(hint)
        return base, tuple(notes)
    return hint, ()


def checked(hint: Any, value: Any, where: str) -> Any:
    """``value`` as its annotation wants it.

    Args:
        hint: the annotation.
        value: what was given, from a file or from Python.
        where: the field, for messages.

    Raises:
        ConfigError: it is of another type, or a note complains.
    """
    base, notes = parted(hint)
    value = _typed(base, value, where)
    for note in notes:
        complaint = note(value)
        if complaint:
            raise ConfigError(f"{where}: {shown(value)} {complaint}")
    return value


def near(word: str, known: Sequence[str]) -> str:
    """ "did you mean 'x'?" for the known word that is nearest, in small letters or as it is, or nothing."""
    found = difflib.get_close_matches(word, known, n=1) or difflib.get_close_matches(word.lower(), known, n=1)
    return f"did you mean {found[0]!r}?" if found else ""


def repeated(names: Sequence[Any]) -> Any:
    """The first of the names that was there before; None if each is there once."""
    return next((name for place, name in enumerate(names) if name in names[:place]), None)


def shown(value: Any) -> str:
    """A value as a user would write it."""
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(shown, value))}]"
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)


def _typed(base: Any, value: Any, where: str) -> Any:
    if get_origin(base) is Literal:
        if value not in get_args(base):
            hint = near(str(value), get_args(base))
            raise ConfigError(
                f"{where}: unknown value {value!r}; {hint + ' ' if hint else ''}"
                f"choose one of {', '.join(get_args(base))}"
            )
        return value
    if get_origin(base) is tuple:
        return _list(get_args(base), value, where)
    if value is None or value == "":
        raise ConfigError(f"{where}: no value is given; write {where}=VALUE")
    if base in (bool, str):
        if isinstance(value, base):
            return value
    elif not isinstance(value, bool):
        number = _number(value)
        if number is not None and not math.isfinite(number):
            raise ConfigError(f"{where}: {value!r} is not a finite number")
        if number is not None and base is float:
            return number
        if number is not None and number.is_integer():
            return int(value) if isinstance(value, int) else int(number)
    raise ConfigError(f"{where}: {value!r} is not {_NAMED[base]}")


_NAMED = {int: "an integer", float: "a number", bool: "true or false", str: "a text"}


def _list(items: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ConfigError(f"{where}: {value!r} is not a list; write {where}=[a,b]")
    if items[-1] is Ellipsis:
        items = (items[0],) * len(value)
    if len(items) != len(value):
        raise ConfigError(f"{where}: {shown(value)} has {len(value)} values; {len(items)} wanted")
    return tuple(checked(item, each, f"{where}[{place}]") for place, (item, each) in enumerate(zip(items, value)))


def _number(value: Any) -> float | None:
    """A real number as a float, also from text: YAML reads 1e-3 as text."""
    if not isinstance(value, (Real, str)):
        return None
    try:
        return float(value)
    except ValueError:
        return None
    except OverflowError:
        return math.inf


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, tuple):
        for each in value:
            yield from _numbers(each)
    else:
        yield value


def bounds_of(hint: Any) -> Bounds | None:
    """The bounds beside a field, or beside the entries of its list; None where it has none."""
    base, notes = parted(hint)
    inner = get_args(base)[:1] if get_origin(base) is tuple else ()
    return next((found for found in (*notes, *map(bounds_of, inner)) if isinstance(found, Bounds)), None)
