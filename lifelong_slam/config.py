"""From a composed config to objects, with errors that name the right key."""

import inspect
from collections.abc import Mapping
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError

from lifelong_slam.errors import ConfigError, LifelongSlamError, did_you_mean

_CHECKED_TYPES = (bool, int, float, str)


def build(config: DictConfig) -> Any:
    """Instantiate a config's `_target_`, and those nested in it, after checking keys and values.

    Raises:
        ConfigError: a key is unknown or missing, or a value has the wrong type.
        LifelongSlamError: whatever the target itself raises on purpose.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    _check(plain)
    try:
        return instantiate(plain, _convert_="all")
    except InstantiationException as error:
        if isinstance(error.__cause__, LifelongSlamError):
            raise error.__cause__ from None
        raise ConfigError(" ".join(str(error).split())) from error


def _check(node: Any) -> None:
    """Check every mapping below `node` that has a `_target_`."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            _check_arguments(node)
        for value in node.values():
            _check(value)
    elif isinstance(node, list):
        for value in node:
            _check(value)


def _check_arguments(node: Mapping[str, Any]) -> None:
    target = str(node["_target_"])
    try:
        parameters = inspect.signature(get_class(target), eval_str=True).parameters
    except (ImportError, ValueError) as error:
        raise ConfigError(f"_target_ {target} can't be loaded: {error}") from error
    for key, value in node.items():
        if key.startswith("_"):
            continue
        if key not in parameters:
            raise ConfigError(
                f"{target} has no setting '{key}'.{did_you_mean(key, parameters)}"
                f" It takes: {', '.join(parameters)}"
            )
        _check_value(f"{target}: {key}", value, parameters[key].annotation)


def _check_value(where: str, value: Any, annotation: Any) -> None:
    """Check plain values (and optional ones) against the annotation of their parameter."""
    kinds = set(getattr(annotation, "__args__", (annotation,)))
    if not kinds <= {*_CHECKED_TYPES, type(None)}:
        return
    try:
        TypeAdapter(annotation).validate_python(value)
    except ValidationError as error:
        raise ConfigError(f"{where}: {error.errors()[0]['msg']}, got {value!r}") from error
