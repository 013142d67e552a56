# SPDX-License-Identifier: Apache-2.0
"""Settings given as `name.of.setting=value` on top of others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from ggslam.errors import ConfigError
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml

Settings = TypeVar("Settings")


def with_overrides(overrides: Sequence[str] | None, values: dict[str, Any] | None = None) -> dict[str, Any]:
    """Nested dictionaries of what `name.of.setting=value` texts say, in order, added to `values`.

    Raises:
        ConfigError: a text has no name or no value that can be read; or no list was given.
    """
    if overrides is not None and (isinstance(overrides, (str, bytes)) or not isinstance(overrides, Sequence)):
        raise ConfigError(f'`overrides`: expected a list like ["mapping.iterations_per_frame=1"], found {overrides!r}')
    values = {} if values is None else values
    for override in overrides or []:
        name, equals, text = override.partition("=")
        if not equals:
            raise ConfigError(f"`overrides` {override}: expected name=value")
        try:
            value = parse_yaml(text)
        except PlainYamlError as error:
            raise ConfigError(f"`overrides` {override}: cannot be read as a value: {error}") from None
        _assign(values, name.strip().split("."), value, override)
    return values


def settings_with(kind: type[Settings], overrides: Sequence[str] | None) -> tuple[Settings, dict[str, Any]]:
    """Settings of a class with overrides, and the nested values that they set.

    Raises:
        ConfigError: naming the setting.
    """
    values = with_overrides(overrides)
    try:
        return kind(**values), values
    except ConfigError as error:
        raise ConfigError(f"`overrides`: {error}") from None


def _assign(values: dict[str, Any], names: list[str], value: Any, override: str) -> None:
    for name in names[:-1]:
        values = values.setdefault(name, {})
        if not isinstance(values, dict):
            raise ConfigError(f"`overrides` {override}: {name} is a value, not a group")
    values[names[-1]] = value
