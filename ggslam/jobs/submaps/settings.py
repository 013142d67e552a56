# SPDX-License-Identifier: Apache-2.0
"""Settings of making a grid store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Any, ClassVar

from ggslam.submaps.settings import SubmapSettings
from ggslam.system.overrides import settings_with
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
    settings, values = settings_with(StoreSettings, overrides)
    return {name: getattr(settings.submaps, name) for name in values.get("submaps", {})}
