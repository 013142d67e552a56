# SPDX-License-Identifier: Apache-2.0
"""What can be set where a grid store is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Any, ClassVar

from ggslam.errors import ConfigError
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.overrides import with_overrides
from ggslam.system.settings import settings_class


@settings_class(frozen=True)
class StoreSettings:
    """Settings of `ggslam submaps`."""

    is_root: ClassVar[bool] = True
    """Errors name settings by their path from here."""
    submaps: SubmapSettings = field(default_factory=SubmapSettings)
    """Of the store, instead of what suits the sensor."""


def store_overrides(overrides: Sequence[str] | None) -> dict[str, Any]:
    """Fields of `SubmapSettings` that `submaps.name=value` texts set.

    Raises:
        ConfigError: naming the setting.
    """
    values = with_overrides(overrides)
    try:
        settings = StoreSettings(**values).submaps
    except ConfigError as error:
        raise ConfigError(f"`overrides`: {error}") from None
    return {name: getattr(settings, name) for name in values.get("submaps", {})}
