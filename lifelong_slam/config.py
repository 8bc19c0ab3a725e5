"""From a composed config to objects, with errors that name the right key."""

import importlib
import inspect
from collections.abc import Mapping, Sequence
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError

from lifelong_slam.errors import ConfigError, did_you_mean

_CHECKED_TYPES = (bool, int, float, str)


def build(config: DictConfig) -> Any:
    """Instantiate a config's `_target_`, and those nested in it, after checking keys and values.

    Raises:
        ConfigError: a key is unknown or missing, or a value has the wrong type.
        Exception: whatever the target itself raises, as it is.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise ConfigError(_missing(error)) from error
    try:
        return instantiate(_checked(plain), _convert_="all")
    except InstantiationException as error:
        if error.__cause__ is not None:
            raise error.__cause__ from None
        raise ConfigError(one_line(error)) from error


def _missing(error: OmegaConfBaseException) -> str:
    key = getattr(error, "full_key", None)
    if key and "issing mandatory value" in str(error):
        return f"{key} has no value: give one with {key}=..."
    return one_line(error)


def one_line(error: Exception) -> str:
    """Return an error's text without line breaks, or its type where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def _checked(node: Any) -> Any:
    """Return a config with each mapping that has a `_target_` checked and its values converted."""
    if isinstance(node, Mapping):
        plain = {key: _checked(value) for key, value in node.items()}
        return _checked_arguments(plain) if "_target_" in plain else plain
    if isinstance(node, list):
        return [_checked(value) for value in node]
    return node


def _checked_arguments(node: dict[str, Any]) -> dict[str, Any]:
    target = str(node["_target_"])
    try:
        module, _, attribute = target.rpartition(".")
        called = getattr(importlib.import_module(module), attribute)
        parameters = dict(inspect.signature(called, eval_str=True).parameters)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise ConfigError(f"_target_ {target} can't be loaded: {one_line(error)}") from error
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return node
    given = {key: value for key, value in node.items() if not key.startswith("_")}
    _check_keys(_short(target), given, parameters)
    converted = {
        key: check_value(f"{_short(target)}: {key}", value, parameters[key].annotation)
        for key, value in given.items()
    }
    return {**node, **converted}


def _check_keys(
    name: str, given: Mapping[str, Any], parameters: Mapping[str, inspect.Parameter]
) -> None:
    for key in given:
        if key not in parameters:
            raise ConfigError(
                f"{name} has no setting '{key}'.{did_you_mean(key, parameters)}"
                f" It takes: {', '.join(parameters)}"
            )
    absent = [k for k, p in parameters.items() if p.default is p.empty and k not in given]
    if absent:
        raise ConfigError(f"{name} needs a value for: {', '.join(absent)}")


def check_value(where: str, value: Any, annotation: Any) -> Any:
    """Return a plain (or optional) value as its annotation wants it; other kinds as they are.

    Raises:
        ConfigError: it has another type, in words that begin with `where`.
    """
    if not _is_plain(annotation):
        return value
    if type(value) is int and annotation in (str, str | None):
        return str(value)  # a folder may be called 2011
    try:
        return TypeAdapter(annotation).validate_python(value)
    except ValidationError as error:
        raise ConfigError(f"{where}: {error.errors()[0]['msg']}, got {value!r}") from error


def _is_plain(annotation: Any) -> bool:
    """Tell whether a type is made of numbers, strings and containers of them."""
    if get_origin(annotation) is Literal:
        return True
    arguments = [a for a in get_args(annotation) if a is not Ellipsis]
    if not arguments:
        return annotation in (*_CHECKED_TYPES, type(None))
    containers = (Union, UnionType, list, dict, tuple, Sequence, Mapping)
    return get_origin(annotation) in containers and all(map(_is_plain, arguments))


def _short(target: str) -> str:
    return target.rpartition(".")[2]
