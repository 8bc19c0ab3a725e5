"""Finds metrics: those a config names, and those that installed packages offer.

A package offers a metric by an entry point of the group `lifelong_slam.metrics` that leads to its class;
it is made with the defaults of its settings, unless the config names the class itself.
"""

import importlib
import inspect
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, get_type_hints

from pydantic import PydanticSchemaGenerationError, TypeAdapter, ValidationError

from eval.errors import EvalError, MetricError
from eval.metrics.metric import Metric

GROUP = "lifelong_slam.metrics"


def find_metrics(configs: Iterable[Mapping[str, Any]]) -> tuple[Metric, ...]:
    """Make the metrics of a config, then those of installed packages that it doesn't name.

    Args:
        configs: a `_target_` and settings each.

    Raises:
        MetricError: a metric can't be imported or made, is no metric, or two have one name or title.
    """
    metrics = [make_metric(config) for config in configs]
    named = [type(metric) for metric in metrics]
    for entry in entry_points(group=GROUP):
        plugin = _load(entry)
        if not any(plugin is known for known in named):
            metrics.append(_make(plugin, {}, f"metric {entry.name} of {entry.value}"))
    _check_unique([metric.name for metric in metrics])
    _check_unique([metric.title for metric in metrics])
    return tuple(metrics)


def make_metric(config: Mapping[str, Any]) -> Metric:
    """Make a metric from its `_target_` and its settings, checked by its type hints.

    Raises:
        MetricError: the class can't be imported, a setting is unknown, missing or of a wrong type, or
            what comes out is no metric.
    """
    if "_target_" not in config:
        raise MetricError(f"a metric needs a _target_, its class: {dict(config)}")
    target = str(config["_target_"])
    module, _, name = target.rpartition(".")
    try:
        plugin = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise MetricError(f"_target_ {target} can't be loaded: {error}") from error
    settings = {key: value for key, value in config.items() if not key.startswith("_")}
    return _make(plugin, settings, target)


def check_value(where: str, value: Any, annotation: Any) -> Any:
    """Return a value as its type hint wants it; hints of no plain type take anything.

    Raises:
        MetricError: it has another type, in words that begin with `where`.
    """
    try:
        return TypeAdapter(annotation).validate_python(value)
    except PydanticSchemaGenerationError:
        return value
    except ValidationError as error:
        raise MetricError(f"{where}: {error.errors()[0]['msg']}, got {value!r}") from error


def _check_unique(names: list[str]) -> None:
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise MetricError(f"more than one metric is called {', '.join(twice)}")


def _load(entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except Exception as error:  # whatever an installed package may raise on import
        raise MetricError(
            f"metric {entry.name} of {entry.value} can't be loaded: {error}; repair or uninstall it"
        ) from error


def _make(plugin: Any, settings: Mapping[str, Any], where: str) -> Metric:
    if not (inspect.isclass(plugin) and hasattr(plugin, "measure")):
        raise MetricError(f"{where} is no class of metrics: it has no method measure")
    try:
        bound = inspect.signature(plugin).bind(**settings)
    except TypeError as error:
        takes = ", ".join(inspect.signature(plugin).parameters) or "no settings"
        raise MetricError(f"{where}: {error}; it takes: {takes}") from error
    hints = get_type_hints(plugin.__init__) if bound.arguments else {}
    checked = {
        key: check_value(f"{where}: {key}", value, hints.get(key, Any))
        for key, value in bound.arguments.items()
    }
    try:
        metric = plugin(**checked)
    except EvalError:
        raise
    except Exception as error:  # whatever a class of somebody else may raise
        raise MetricError(f"{where} can't be made: {type(error).__name__}: {error}") from error
    if not isinstance(metric, Metric):
        absent = [name for name in _ATTRIBUTES if not hasattr(metric, name)]
        raise MetricError(f"{where} is no metric: it lacks {', '.join(absent)}")
    return metric


_ATTRIBUTES = (*Metric.__annotations__, "measure")
