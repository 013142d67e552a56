# SPDX-License-Identifier: Apache-2.0
"""Every setting in one typed tree. Presets are YAML files in configs/; unknown names and impossible values are refused.

The settings of a part are declared beside the part (`ggslam/tracking`, `ggslam/mapping`), see
`ggslam/system/settings.py`; `Config` puts them together.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import field
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, Literal

import yaml

from ggslam.errors import ConfigError
from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.settings import MapperSettings
from ggslam.movers.settings import MoverSettings
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.object_masks import MaskSettings
from ggslam.submaps.paging_settings import PagingSettings
from ggslam.system.atomic import write_text
from ggslam.system.foreign import given_path, read_foreign_text
from ggslam.system.overrides import with_overrides
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml
from ggslam.system.settings import setting, settings_class
from ggslam.tracking.edges_planes.settings import FeatureTrackerSettings
from ggslam.tracking.keyframes import KeyframeSettings
from ggslam.tracking.settings import TrackerSettings
from ggslam.volumes.volume_settings import VolumeSettings

OLD_EDGES_PLANES = "features"
"""What `edges_planes` was called."""


class OldNameWarning(FutureWarning):
    """A setting was given by the name that it had in an earlier version."""


@settings_class(frozen=True)
class EvaluationSettings:
    """What is kept away from training, so that it can be scored honestly."""

    held_out_every: int = setting(8, 0, 10**9, "frames", basic=True)
    """Every n-th frame is tracked but never a keyframe and never trained on; 0: none."""
    held_out_offset: int = setting(4, 0, 10**9, "frames")
    """The first frame held out, modulo `held_out_every`; the first keyframe never is."""

    def is_held_out(self, frame_index: int) -> bool:
        """Whether the frame is kept for scoring."""
        every = self.held_out_every
        return every > 0 and frame_index % every == self.held_out_offset % every


@settings_class(frozen=True)
class Config:
    """Settings of a run."""

    is_root: ClassVar[bool] = True
    """Errors name settings by their path from here."""
    seed: int = setting(0, 0, 2**63 - 1, basic=True)
    """Of every random draw. A synchronous run on one machine repeats bit for bit."""
    threads: int = setting(0, 0, 1024, basic=True)
    """Threads of the compiled core; 0: the processors this process may use."""
    device: Literal["auto", "cpu", "cuda"] = setting("cpu", basic=True)
    """Where map and keyframes are kept, trained and tracked: cuda: an NVIDIA GPU (compiled by nvcc when first used);
    auto: that if it can be had and memory is not limited, else cpu."""
    sh_degree: int = setting(0, 0, 3, basic=True)
    """Spherical-harmonic degree of the colours."""
    tracker: Literal["gicp", "edges_planes"] = setting("gicp", basic=True)
    """gicp: G-ICP against the keyframes' points; edges_planes: edges and planes in a budget of time, and G-ICP where
    they do not convince."""
    realtime_fps: float = setting(0.0, 0, 1e4, "frames/s", basic=True)
    """0: synchronous. Otherwise frames arrive at this rate like from a camera; tracker and mapper run side by side."""
    refine_iterations: int = setting(-1, -1, 10**7, basic=True)
    """Optimisation steps after the last frame, see `mapping.average_last`; 0: none; -1: 1.2 for each one before and
    ten for each keyframe at least, which gains two decibels (0.4 at a camera's pace; 0.7 on a GPU and where memory is
    limited)."""
    memory_limit_mb: float = setting(0.0, 0, 1e9, "MB", basic=True)
    """Resident memory of the run: what does not fit of map and keyframes is kept on disk; 0: no limit."""
    tracking: TrackerSettings = field(default_factory=TrackerSettings)
    edges_planes: FeatureTrackerSettings = field(default_factory=FeatureTrackerSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    loops: LoopSettings = field(default_factory=LoopSettings)
    mapping: MapperSettings = field(default_factory=MapperSettings)
    identity: IdentitySettings = field(default_factory=IdentitySettings)
    masks: MaskSettings = field(default_factory=MaskSettings)
    movers: MoverSettings = field(default_factory=MoverSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    paging: PagingSettings = field(default_factory=PagingSettings)
    volumes: VolumeSettings = field(default_factory=VolumeSettings)


def config_to_dict(config: Config) -> dict[str, Any]:
    """The settings as nested dictionaries of plain values, in the order of the fields."""
    return _plain(dataclasses.asdict(config))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value.value if hasattr(value, "value") else value


def config_from_dict(values: dict[str, Any], origin: str = "settings") -> Config:
    """The settings from nested dictionaries; what is not named keeps its default.

    Raises:
        ConfigError: an unknown name (the nearest known one is suggested) or a value of the wrong type or range.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{origin}: top level: expected names with values, found {values!r}")
    if unnamed := [name for name in values if not isinstance(name, str)]:
        raise ConfigError(f"{origin}: unknown setting {unnamed[0]}")
    try:
        return Config(**with_new_names(values)[0])
    except ConfigError as error:
        raise ConfigError(f"{origin}: {error}") from None


def with_new_names(values: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Settings in which names of earlier versions are replaced, and what was replaced, for people."""
    values, said = dict(values), []
    if values.get("tracker") == OLD_EDGES_PLANES:
        values["tracker"] = "edges_planes"
        said.append(f"tracker: {OLD_EDGES_PLANES} is the old name of edges_planes")
    if OLD_EDGES_PLANES in values:
        old = values.pop(OLD_EDGES_PLANES)
        new = values.setdefault("edges_planes", old)
        if new is not old and isinstance(old, dict) and isinstance(new, dict):
            values["edges_planes"] = _merge(old, new)
        said.append(f"{OLD_EDGES_PLANES} is the old name of the settings edges_planes")
    return values, said


def _merge(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Nested values of both; the new ones where both have one."""
    both = {name: _merge(old[name], value) if isinstance(value, dict) and isinstance(old.get(name), dict) else value
            for name, value in new.items()}  # fmt: skip
    return {**old, **both}


def presets() -> dict[str, Path]:
    """The presets that come with ggslam: name -> file."""
    folders = [Path(__file__).parents[2] / "configs", Path(str(resources.files("ggslam"))) / "configs"]
    return {path.stem: path for folder in folders if folder.is_dir() for path in sorted(folder.glob("*.yaml"))}


def load_config(preset_or_file: str | Path | None = None, overrides: Sequence[str] | None = None) -> Config:
    """Settings from a preset's name or a YAML file, then `name.of.setting=value` overrides, in order.

    Names of earlier versions are understood, with an `OldNameWarning`.

    Raises:
        ConfigError: naming the file and the setting.
    """
    values: dict[str, Any] = {}
    origin = "settings"
    if preset_or_file is not None:
        path = given_path(preset_or_file, ConfigError)
        if not path.suffix and str(preset_or_file) in presets():
            path = presets()[str(preset_or_file)]
        values, origin = _read_yaml(path), str(path)
        config_from_dict(values, origin)
    with_overrides(overrides, values)
    for said in with_new_names(values)[1]:
        warnings.warn(said, OldNameWarning, stacklevel=2)
    return config_from_dict(values, "`overrides`" if overrides else origin)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        if not path.exists():
            raise ConfigError(f"{path}: no such file, nor a preset (presets: {', '.join(presets())})")
        values = parse_yaml(read_foreign_text(path, ConfigError))
    except PlainYamlError as error:
        raise ConfigError(f"{path}: cannot be read as YAML: {error}") from None
    return values if values is not None else {}


def save_config(config: Config, path: Path) -> None:
    """Writes all settings, defaults included, as YAML."""
    write_text(path, yaml.safe_dump(config_to_dict(config), sort_keys=False))
