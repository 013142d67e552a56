# SPDX-License-Identifier: Apache-2.0
"""Settings of localization in stored maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ggslam.localization.scan_look_up import ScanLookUpSettings
from ggslam.localization.scan_tracker import ScanTrackerSettings
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.overrides import settings_with
from ggslam.system.settings import settings_class
from ggslam.tracking.settings import TrackerSettings


@settings_class(frozen=True)
class LocalizeSettings:
    """Settings of `ggslam localize`."""

    is_root: ClassVar[bool] = True
    """Errors name settings by their path from here."""
    scans: ScanTrackerSettings = field(default_factory=ScanTrackerSettings)
    """Of laser scans."""
    look_up: ScanLookUpSettings = field(default_factory=ScanLookUpSettings)
    """Of laser scans whose place is not known."""
    tracking: TrackerSettings = field(default_factory=TrackerSettings)
    """Of images, as for a run."""
    submaps: SubmapSettings = field(default_factory=SubmapSettings)
    """Of the map in memory, instead of the store's own or what suits the sensor. Grid and voxels are for clouds, which
    are cut into cells first."""


@dataclass(frozen=True)
class ChosenSettings:
    """Settings, and what of the map's was set on purpose: fields of `SubmapSettings`."""

    settings: LocalizeSettings
    submaps: Mapping[str, Any]


def localize_settings(overrides: Sequence[str] | None) -> ChosenSettings:
    """The settings with `name.of.setting=value` overrides.

    Raises:
        ConfigError: naming the setting.
    """
    settings, values = settings_with(LocalizeSettings, overrides)
    return ChosenSettings(settings, {name: getattr(settings.submaps, name) for name in values.get("submaps", {})})
