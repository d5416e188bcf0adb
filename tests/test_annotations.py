"""Every public edge is annotated: what is in a module's ``__all__`` says what it takes and what it gives back."""

import importlib
import inspect
import pkgutil
import typing

import pytest

import august_jax


def _methods(owner):
    """Name and function of the public methods that a class's own source defines."""
    for name, value in vars(owner).items():
        inner = value.fget if isinstance(value, property) else inspect.unwrap(getattr(value, "__func__", value))
        written = inspect.isfunction(inner) and inner.__module__ == owner.__module__  # not by dataclass or NamedTuple
        if written and (not name.startswith("_") or name in ("__init__", "__call__")):
            yield name, inner


def _edges():
    """Dotted name -> function, of all functions and of all public methods of classes that some ``__all__`` names."""
    found = {}
    for module_info in pkgutil.walk_packages(august_jax.__path__, "august_jax."):
        module = importlib.import_module(module_info.name)
        for name in getattr(module, "__all__", ()):
            public = getattr(module, name)
            home = getattr(public, "__module__", None) or ""
            if not home.startswith("august_jax") or typing.get_origin(public):
                continue  # a constant, an alias
            if inspect.isclass(public):
                found |= {f"{home}.{public.__qualname__}.{name}": method for name, method in _methods(public)}
            elif callable(public):
                found[f"{home}.{name}"] = inspect.unwrap(public)
    return found


EDGES = _edges()


def test_there_are_edges_to_look_at():
    assert len(EDGES) > 50


@pytest.mark.parametrize("name", EDGES)
def test_public_edges_are_annotated(name):
    function = EDGES[name]
    signature = inspect.signature(function)
    bare = [
        parameter.name
        for parameter in signature.parameters.values()
        if parameter.annotation is parameter.empty and parameter.name not in ("self", "cls")
    ]
    if signature.return_annotation is signature.empty and not name.endswith(".__init__"):
        bare.append("return")
    assert not bare, f"{name}: no annotation for {', '.join(bare)}"
