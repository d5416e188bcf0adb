"""Configurations as text: YAML, dotted overrides, digests."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from august_jax.config.fields import ConfigError, checked, hints, near, parted, repeated
from august_jax.config.schema import Config

_SUMMED = re.compile(r"# check sum of the lines below: ([0-9a-f]{16})\n")


def override(config: Config, assignments: Sequence[str], sections: Mapping[str, Any] | None = None) -> Config:
    """Apply dotted assignments such as ``train.steps=2000`` in order.

    Args:
        config: what they change.
        assignments: the values are YAML.
        sections: to stand in the place of ``config``'s before anything is assigned; what fields owe each other is asked
            of the outcome alone.

    Raises:
        ConfigError: names the field, the value and what was wanted.
    """
    tree = to_dict(config) | {name: _plain(section) for name, section in (sections or {}).items()}
    for text in assignments:
        path, separator, raw = (part.strip() for part in text.partition("="))
        if not separator:
            raise ConfigError(f"override {text!r} is not of the form section.field=value, e.g. train.steps=2000")
        if path == "preset":
            raise ConfigError(
                f"preset: {raw!r} cannot be an override; a preset is what overrides change, so begin with that one"
            )
        *parents, leaf = path.split(".")
        node: Any = tree
        for depth, key in enumerate([*parents, leaf]):
            if not isinstance(node, dict) or key not in node:
                known = sorted(node) if isinstance(node, dict) else []
                hint = near(key, known) or f"known here: {', '.join(known) or 'nothing below'}"
                raise ConfigError(f"{path}: unknown field {key!r}; {hint}")
            if depth < len(parents):
                node = node[key]
        node[leaf] = _loaded(raw, path)
    return from_dict(tree)


def to_dict(config: Config) -> dict[str, Any]:
    """Nested dictionaries and lists, fit for YAML and JSON."""
    return _plain(config)


def _plain(section: Any) -> dict[str, Any]:
    tree: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(section)))
    return tree


def from_dict(tree: Mapping[str, Any]) -> Config:
    """Inverse of :func:`to_dict`; fields that are missing take their defaults.

    Raises:
        ConfigError: an unknown field, or a value that cannot work.
    """
    config: Config = _build(Config, tree, "")
    return config


def to_yaml(config: Config) -> str:
    """The configuration as YAML text."""
    import yaml

    return str(yaml.safe_dump(to_dict(config), sort_keys=False))


def to_summed_yaml(config: Config) -> str:
    """:func:`to_yaml` below a line with its check sum, a comment to YAML: what runs and results keep, and :func:`read`
    compares."""
    text = to_yaml(config)
    return f"# check sum of the lines below: {_sum_of(text)}\n{text}"


def from_yaml(text: str) -> Config:
    """Inverse of :func:`to_yaml`.

    Raises:
        ConfigError: no YAML, an unknown field, or a value that cannot work.
    """
    tree = _loaded(text, "config")
    if not isinstance(tree, Mapping):
        raise ConfigError("config: the text holds no mapping of sections")
    return from_dict(tree)


def read(path: str | os.PathLike[str]) -> Config:
    """The configuration in a file that :func:`to_summed_yaml` made, or :func:`to_yaml`, of which no sum is compared.

    Raises:
        ConfigError: names the file, and what is wrong in it.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        summed = _SUMMED.match(text)
        if summed and summed[1] != _sum_of(text[summed.end() :]):
            raise ConfigError("its first line holds the check sum of other lines; if you changed these, remove it")
        return from_yaml(text)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: {error}\nit is damaged, edited or of another version; correct it, or make that folder again"
        ) from None


def digest(*parts: Any) -> str:
    """Sixteen hexadecimal digits that identify configuration sections and plain values by content."""
    plain = [
        dataclasses.asdict(part) if dataclasses.is_dataclass(part) and not isinstance(part, type) else part
        for part in parts
    ]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def data_digest(config: Config) -> str:
    """Identity of the samples that ``config`` describes; the count and the shard size are not part of it.

    Region and signal are part of it where samples keep what the base station made of them, and the threshold of the
    prediction where tables are made for as much.
    """
    seen: tuple[Any, ...] = (config.region, config.signal) if config.data.observed else ()
    if config.data.solver == "table":
        seen += (config.region.threshold_m,)
    return digest(
        config.array, config.target, config.flight, *seen, config.data.seed, config.data.solver, config.data.observed
    )


def _sum_of(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _build(kind: type, tree: Mapping[str, Any], path: str) -> Any:
    known = hints(kind)
    values = {}
    for key, value in tree.items():
        where = f"{path}{key}"
        if key not in known:
            hint = near(str(key), list(known)) or f"known: {', '.join(known)}"
            raise ConfigError(f"{where}: unknown field; {hint}")
        wanted, _ = parted(known[key])
        if dataclasses.is_dataclass(wanted):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: {value!r} is not a section; its fields are {where}.NAME")
            values[key] = _build(wanted, value, where + ".")  # type: ignore[arg-type]
        else:
            values[key] = checked(known[key], value, where)
    return kind(**values)


def _loaded(text: str, where: str) -> Any:
    """What a YAML text says; ConfigError with ``where`` for what it cannot mean."""
    import yaml

    try:
        return yaml.load(text, Loader=_loader())
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None and "\n" in text else ""
        what = getattr(error, "problem", None) or str(error).splitlines()[0]
        marks = "; put a text with marks such as ? in double quotes" if "?" in what else ""
        raise ConfigError(
            f"{where}: {text if len(text) < 60 else 'the text'!r} is not YAML ({what}{line}){marks}"
        ) from None


@cache
def _loader() -> Any:
    """YAML's safe loader, without its numbers that are not what they seem and without fields given twice."""
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc, unused-ignore]
        def construct_yaml_int(self, node: Any) -> int:
            if re.match(r"[-+]?0[0-9_]", node.value):
                raise yaml.constructor.ConstructorError(
                    problem=f"{node.value} begins with a zero, which YAML takes for octal; leave the zero out"
                )
            if ":" in node.value:
                raise yaml.constructor.ConstructorError(problem=f"{node.value} would be a number of base 60")
            return int(super().construct_yaml_int(node))

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            names = [key.value for key, _ in node.value]
            twice = repeated(names)
            if twice is not None:
                raise yaml.constructor.ConstructorError(problem=f"{twice} is given twice")
            return super().construct_mapping(node, deep)

    Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_yaml_int)
    return Loader
