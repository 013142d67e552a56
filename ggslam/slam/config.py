# SPDX-License-Identifier: Apache-2.0
"""Every setting in one typed tree. Presets are YAML files in configs/; unknown names and impossible values are refused.

Public settings are what users turn; the others are internal tuning, see `ggslam/system/settings.py`. The settings of a
part are declared beside the part (`ggslam/tracking`, `ggslam/mapping`); `Config` puts them together.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence, Set
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
from ggslam.system.overrides import with_overrides
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml
from ggslam.system.settings import changed_tuning, setting, settings_class, tuning_class, tuning_note, walk
from ggslam.system.untrusted_files import given_path, read_untrusted_text
from ggslam.tracking.edges_planes.settings import FeatureTrackerSettings
from ggslam.tracking.keyframes import KeyframeSettings
from ggslam.tracking.settings import TrackerSettings
from ggslam.volumes.volume_settings import VolumeSettings

OLD_EDGES_PLANES = "features"
"""What `edges_planes` was called."""


class OldNameWarning(FutureWarning):
    """A setting was given by the name that it had in an earlier version."""


@tuning_class(frozen=True)
class EvaluationTuning:
    """Which frames are held out."""

    held_out_offset: int = setting(4, 0, 10**9, "frames")
    """First held-out frame, modulo `held_out_every`; the first keyframe is never held out."""


@settings_class(frozen=True)
class EvaluationSettings(EvaluationTuning):
    """Frames that are held out from training, to score the map on views it has not seen."""

    held_out_every: int = setting(8, 0, 10**9, "frames", basic=True)
    """Every n-th frame is tracked but never becomes a keyframe and is never trained on; 0: none."""

    def is_held_out(self, frame_index: int) -> bool:
        """Whether the frame is kept for scoring."""
        every = self.held_out_every
        return every > 0 and frame_index % every == self.held_out_offset % every


RETIRED = ("loops.revisits.rest", "mapping.rates.features")
"""Internal numbers that earlier versions had and that changed no run; files and overrides may still name them."""


@settings_class(frozen=True)
class Config:
    """Settings of a run."""

    is_root: ClassVar[bool] = True
    """Errors name settings by their path from here."""
    seed: int = setting(0, 0, 2**63 - 1, basic=True)
    """Seed of every random draw. A synchronous run on one machine repeats bit for bit."""
    threads: int = setting(0, 0, 1024, basic=True)
    """Threads of the compiled core; 0: all processors this process may use."""
    device: Literal["auto", "cpu", "cuda"] = setting("cpu", basic=True)
    """Where the map and its keyframes are stored, trained and tracked. cuda: an NVIDIA GPU (nvcc compiles the kernels
    on first use); auto: the GPU if there is one and `memory_limit_mb` is 0, else the CPU."""
    sh_degree: int = setting(-1, -1, 3, basic=True)
    """Degree of the spherical harmonics that describe a Gaussian's colour. -1: 0 while it is trained; after the final
    refinement (CPU, all of the map in memory) 2 where views ask for it. 0: one colour from all sides; 1 to 3: trained
    from the start."""
    tracker: Literal["gicp", "edges_planes"] = setting("gicp", basic=True)
    """How frames are located. gicp: G-ICP against the points of the keyframes; edges_planes: edges and planes within a
    time budget per frame, and G-ICP where they fail."""
    realtime_fps: float = setting(0.0, 0, 1e4, "frames/s", basic=True)
    """0: process every frame in turn. Otherwise frames arrive at this rate, as from a camera, and tracker and mapper
    run in parallel."""
    refine_iterations: int = setting(-1, -1, 10**7, basic=True)
    """Training steps after the last frame; 0: none. -1: automatic: 1.3 x the steps so far, at least 10 per keyframe
    (2 x where depth is exact, 3 x if images are large, too; 0.7 x with a memory limit; in real time 0.4 x, on a GPU
    0.7 x). Gains about 2 dB."""
    memory_limit_mb: float = setting(0.0, 0, 1e9, "MB", basic=True)
    """Resident memory the run may use: parts of the map and keyframe images that do not fit are moved to disk. 0: no
    limit."""
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

    @property
    def fits_view_colors(self) -> bool:
        """Whether colours that depend on the view are fitted after training, and not trained."""
        return self.sh_degree < 0


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
    """The settings from nested dictionaries; what is not named keeps its default, and retired names are skipped.

    Raises:
        ConfigError: an unknown name (the nearest known one is suggested) or a value of the wrong type or range.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{origin}: top level: expected names with values, found {values!r}")
    if unnamed := [name for name in values if not isinstance(name, str)]:
        raise ConfigError(f"{origin}: unknown setting {unnamed[0]}")
    if retired := _find_retired(values):
        values = _without(set(retired), values)
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
    values, origin = _read_preset(preset_or_file)
    if preset_or_file is not None:
        config_from_dict(values, origin)
    with_overrides(overrides, values)
    for said in with_new_names(values)[1]:
        warnings.warn(said, OldNameWarning, stacklevel=2)
    return config_from_dict(values, "`overrides`" if overrides else origin)


def settings_notes(
    config: Config, preset_or_file: str | Path | None = None, overrides: Sequence[str] | None = None
) -> list[str]:
    """What a user is told of settings that were given to `load_config`: internal ones, and those without effect."""
    retired = _find_retired(with_overrides(overrides, _read_preset(preset_or_file)[0]))
    notes = [tuning_note(config), f"has no effect any more: {', '.join(retired)}" if retired else ""]
    return [note for note in notes if note]


def _find_retired(values: dict[str, Any]) -> list[str]:
    """Retired names among nested settings."""
    found = []
    for path in RETIRED:
        *groups, name = path.split(".")
        inner: Any = values
        for group in groups:
            inner = inner.get(group) if isinstance(inner, dict) else None
        if isinstance(inner, dict) and name in inner:
            found.append(path)
    return found


def _read_preset(preset_or_file: str | Path | None) -> tuple[dict[str, Any], str]:
    """What a preset or file says, and its place."""
    if preset_or_file is None:
        return {}, "settings"
    path = given_path(preset_or_file, ConfigError)
    if not path.suffix and str(preset_or_file) in presets():
        path = presets()[str(preset_or_file)]
    return _read_yaml(path), str(path)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        if not path.exists():
            raise ConfigError(f"{path}: no such file, nor a preset (presets: {', '.join(presets())})")
        values = parse_yaml(read_untrusted_text(path, ConfigError))
    except PlainYamlError as error:
        raise ConfigError(f"{path}: cannot be read as YAML: {error}") from None
    return values if values is not None else {}


def save_config(config: Config, path: Path) -> None:
    """Writes the public settings, defaults included, and the internal ones that differ from their defaults, as YAML."""
    left_out = {one.path for one in walk(Config) if one.internal} - set(changed_tuning(config))
    write_text(path, yaml.safe_dump(_without(left_out, config_to_dict(config)), sort_keys=False))


def _without(paths: Set[str], values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings less some; groups that become empty go, too."""
    kept: dict[str, Any] = {}
    for name, value in values.items():
        inner = _without(paths, value, f"{prefix}{name}.") if isinstance(value, dict) else value
        if prefix + name not in paths and inner != {}:
            kept[name] = inner
    return kept
