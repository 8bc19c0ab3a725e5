"""Composes configs from command lines, and says which override does not fit and what was meant."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf

from lifelong_slam.config import one_line
from lifelong_slam.errors import ConfigError, did_you_mean

_HYDRA_VERSION = "1.3"
# Settings that are names of files and folders, of all commands.
_PATHS = {
    *("hydra.run.dir", "hydra.sweep.dir", "map", "scenario.cache_dir"),
    *("scenario.path", "scenario.times", "scenario.poses"),
    *(
        "estimate",
        "reference",
        "reference_map",
        "relations",
        "grid",
        "reference_grid",
        "run",
        "out",
    ),
    *("graph", "truth", "json"),
}
_SWEEP = re.compile(r",|(choice|range|interval|glob|shuffle|sort|tag)\(")


def quote_paths(arguments: Sequence[str]) -> list[str]:
    """Return a command line whose paths are quoted, so that Hydra takes them as the shell gave them.

    Its grammar gives a meaning to commas, brackets, equals signs, tildes and spaces, and knows no umlauts.
    These keep it in a path: quotes around all of it, ``null``, ``${...}``, and, with ``-m``, commas
    between the values of a sweep.

    Args:
        arguments: overrides and options; the latter stay as they are.
    """
    sweeps = bool({"-m", "--multirun", "hydra.mode=MULTIRUN"} & {*arguments})
    return [_with_quoted_path(argument, sweeps) for argument in arguments]


def _with_quoted_path(argument: str, sweeps: bool) -> str:
    key, _, value = argument.partition("=")
    if key.lstrip("+") not in _PATHS or value in ("", "null") or "${" in value:
        return argument
    swept = sweeps and _SWEEP.search(value) is not None
    quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "'\""
    if (swept or quoted) and not Path(value).exists():
        return argument
    return f"{key}={QuotedString(value, Quote.single).with_quotes()}"


def compose_checked(folder: Path, overrides: Sequence[str], name: str = "config") -> DictConfig:
    """Return the config that a command line asks for.

    Args:
        folder: the root of the config groups.
        overrides: such as ``scenario=A`` or ``seed=1``; see `quote_paths`.
        name: of the primary config.

    Raises:
        ConfigError: an override is no setting, or names a choice that isn't there.
    """
    overrides = quote_paths(overrides)
    check_overrides(folder, overrides, name)
    with initialize_config_dir(str(folder.resolve()), version_base=_HYDRA_VERSION):
        config: DictConfig = compose(name, overrides=[*overrides])
    return config


def check_overrides(
    folder: Path, overrides: Sequence[str], name: str = "config", more: Path | None = None
) -> None:
    """Check that command line overrides fit the configs, each value of a sweep included.

    Hydra says so as well, but in several lines, and in a sweep only after making its folder.

    Args:
        folder: the root of the config groups.
        overrides: such as ``scenario=A,B`` or ``seed=1``.
        name: of the primary config.
        more: a second root of config groups.

    Raises:
        ConfigError: with the nearest right key or choice.
    """
    extra = [f"hydra.searchpath=[file://{more.resolve()}]"] if more else []
    with initialize_config_dir(str(folder.resolve()), version_base=_HYDRA_VERSION):
        try:
            parsed = _parse(overrides)
        except OverrideParseException as error:
            raise ConfigError(
                f"'{error.override}' can't be read: write key=value,"
                " with quotes around values that hold commas or brackets: 'key=\"a, b\"'"
            ) from error
        for lines in _jobs(parsed):
            _check_composes(name, [*lines, *extra])


def _jobs(overrides: list[Override]) -> Iterator[list[str]]:
    """Yield override lines such that each value of each sweep occurs (not each combination)."""
    choices = [_lines(override) for override in overrides]
    yield [lines[0] for lines in choices if lines]
    for i, lines in enumerate(choices):
        for line in lines[1:]:
            yield [line if j == i else other[0] for j, other in enumerate(choices) if other]


def _lines(override: Override) -> list[str]:
    """Return an override as one line for each of its values."""
    if not override.is_sweep_override():
        return [str(override.input_line)]
    if not override.is_discrete_sweep():
        return []  # an interval, for sweepers that draw from it
    key = override.get_key_element()
    return [f"{key}={value}" for value in override.sweep_string_iterator()]


def _check_composes(name: str, lines: list[str]) -> None:
    try:
        compose(name, overrides=lines)
    except MissingConfigException as error:
        if not error.missing_cfg_file or not error.options:
            raise ConfigError(one_line(error)) from error
        group, _, choice = error.missing_cfg_file.rpartition("/")
        raise _wrong_choice(group, choice, error.options) from error
    except ConfigCompositionException as error:
        _name_unknown_key(name, lines)
        raise ConfigError(one_line(error)) from error
    except ValueError as error:  # a number where a group's choice belongs
        for override in _parse(lines):
            value, options = str(override.value()), _options(override)
            if options and value not in options:
                raise _wrong_choice(override.key_or_group, value, options) from error
        raise ConfigError(one_line(error)) from error
    for line in lines:
        if line.startswith("+") and not line.lstrip("+").startswith("hydra"):
            _check_addition(name, lines, line)


def _parse(lines: Sequence[str]) -> list[Override]:
    loader = GlobalHydra.instance().config_loader()
    parsed: list[Override] = OverridesParser.create(config_loader=loader).parse_overrides([*lines])
    return parsed


def _options(override: Override) -> list[str]:
    """Return the choices there are if the override's key is a config group."""
    loader = GlobalHydra.instance().config_loader()
    options: list[str] = loader.get_group_options(override.key_or_group)
    return options


def _wrong_choice(group: str, choice: str, options: Sequence[str]) -> ConfigError:
    return ConfigError(
        f"{group}={choice}: there is no such {group}.{did_you_mean(choice, options)}"
        f" Choices: {', '.join(sorted(options))}"
    )


def _name_unknown_key(name: str, lines: list[str]) -> None:
    """Find the first override whose key is nowhere in the config, and say which keys there are."""
    parsed = _parse(lines)
    choices = [str(override.input_line) for override in parsed if _options(override)]
    try:
        config = compose(name, overrides=choices, return_hydra_config=True)
    except HydraException:
        return  # the choices themselves don't go together, whatever the keys
    for override in parsed:
        if override.input_line not in choices and not override.is_add():
            _walk(config, override.key_or_group)


def _walk(config: DictConfig, key: str) -> None:
    """Follow a dotted key into a config.

    Raises:
        ConfigError: it leads nowhere.
    """
    node: Any = config
    walked = ""
    for part in key.replace("/", ".").split("."):
        keys = [str(k) for k in node] if isinstance(node, DictConfig) else []
        if part not in keys:
            known = [k for k in keys if not k.startswith("_") and k != "hydra"]
            raise ConfigError(
                f"there is no setting '{key}'.{did_you_mean(part, known)}"
                f" {_place(config, walked)} there are: {', '.join(known) or 'none'}"
            )
        node = node[part] if not OmegaConf.is_missing(node, part) else None
        walked = f"{walked}.{part}" if walked else part


def _place(config: DictConfig, key: str) -> str:
    choice = OmegaConf.select(config, f"hydra.runtime.choices.{key}") if key else None
    return f"Under {key}{f'={choice}' if choice else ''}" if key else "At the top"


def _check_addition(name: str, lines: list[str], line: str) -> None:
    """Refuse +key=value where nothing would read it; what has a `_target_` is checked by build."""
    key = line.lstrip("+").partition("=")[0]
    others = [other for other in lines if not other.startswith("+")]
    config = compose(name, overrides=others, return_hydra_config=True)
    parent, grandparent = (_above(config, key, levels) for levels in (1, 2))
    if not ("_target_" in parent or _collects(parent) or _collects(grandparent)):
        _walk(config, key)


def _above(config: DictConfig, key: str, levels: int) -> dict[Any, Any]:
    """Return the mapping so many levels above a dotted key, empty where there is none."""
    above = ".".join(key.split(".")[:-levels])
    node = OmegaConf.select(config, above) if above else None
    plain = OmegaConf.to_container(node) if isinstance(node, DictConfig) else {}
    return plain if isinstance(plain, dict) else {}


def _collects(node: dict[Any, Any]) -> bool:
    """Tell whether a mapping is a collection by name of what has a `_target_`, such as metrics."""
    present = [child for child in node.values() if child is not None]
    return bool(present) and all(isinstance(c, dict) and "_target_" in c for c in present)
