# SPDX-License-Identifier: Apache-2.0
"""Every setting has a range that holds, a text and, where it measures something, a unit."""

from __future__ import annotations

import dataclasses
import math
import re
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from worlds.scanner import Scanner

from ggslam.coding.settings import AttributeSettings, CodecSettings
from ggslam.errors import ConfigError
from ggslam.localization.frames import LookUpSettings
from ggslam.localization.scan_tracker import ScanTrackerSettings
from ggslam.objects.inpainting import InpaintSettings
from ggslam.objects.membership import MembershipSettings
from ggslam.slam.config import Config, config_to_dict, load_config
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.settings import Known, walk
from ggslam.tracking.settings import DepthNoise, PhotometricSettings
from ggslam.volumes.safety import Braking

OTHERS = (
    AttributeSettings, CodecSettings, LookUpSettings, ScanTrackerSettings, InpaintSettings, MembershipSettings,
    SubmapSettings, Scanner, Braking,
)  # fmt: skip
"""Settings classes that are not in `Config`."""
ALL = [(kind, one) for kind in (Config, *OTHERS) for one in walk(kind)]
NUMBERS = [(kind, one) for kind, one in ALL if one.is_number]
MEASURES = re.compile(r"\b(metres|degrees|radians|seconds|milliseconds|10\^6 bytes)\b")
"""Words that say a unit: it belongs into the declaration instead."""
MEASURED = re.compile(r"(_m|_mb|_ms|_deg|_degrees|_pixels|_fps|depth|_range|radius|voxel|rotation(_tolerance)?)$")
"""Ends of names of what is measured."""


def name(pair: tuple[type, Known]) -> str:
    return f"{pair[0].__name__}.{pair[1].path}"


def build(kind: type, path: str, value: Any) -> Any:
    """An object of a settings class with one value that is not the default."""
    first, *rest = path.split(".")
    inner: Any = value
    for part in reversed(rest):
        inner = {part: inner}
    return kind(**{first: inner})


def beyond(one: Known) -> list[float]:
    """The numbers next to the range, on both sides."""
    low, high = one.declaration.low, one.declaration.high
    assert low is not None and high is not None
    if int in (one.kind, *typing.get_args(one.kind)):
        return [low - 1, high + 1]
    return [math.nextafter(low, -math.inf), math.nextafter(high, math.inf), math.nan, math.inf, -math.inf]


def test_how_many_there_are() -> None:
    assert sum(kind is Config for kind, _ in ALL) > 280
    assert 15 <= sum(one.declaration.basic for _, one in ALL) <= 25


@pytest.mark.parametrize("pair", ALL, ids=name)
def test_each_says_what_it_does(pair: tuple[type, Known]) -> None:
    _, one = pair
    assert len(one.text) > 10 and one.text.endswith("."), one.text
    assert not one.text.startswith("...") and not one.text.endswith("..."), f"{one.path} is half a sentence"
    assert not one.is_number or not MEASURES.search(one.text.split(";")[0]), f"the unit of {one.path} is in its text"
    measured = one.kind is float and MEASURED.search(one.path) and "scatter" not in one.path
    if measured and not re.search(r"(relative|share|times|_voxels|_sigmas|factor|0 to 1)", one.path + one.text):
        assert one.declaration.unit, one.path


@pytest.mark.parametrize("pair", NUMBERS, ids=name)
def test_each_number_has_a_range_that_holds(pair: tuple[type, Known]) -> None:
    kind, one = pair
    low, high = one.declaration.low, one.declaration.high
    assert low is not None and high is not None and math.isfinite(low) and math.isfinite(high) and low < high
    assert one.default is None or low <= one.default <= high
    for value in beyond(one):
        with pytest.raises(ConfigError) as caught:
            build(kind, one.path, value)
        path = one.path if kind is Config else f"{kind.__name__}.{one.path}"
        assert str(caught.value) == f"{path}: expected {one.range()}, found {value}"


@pytest.mark.parametrize("pair", [pair for pair in ALL if pair[1].choices or pair[1].kind is bool], ids=name)
def test_each_choice_is_refused_by_its_path(pair: tuple[type, Known]) -> None:
    kind, one = pair
    with pytest.raises(ConfigError, match=rf"{re.escape(one.path)}: expected .* found 'perhaps'"):
        build(kind, one.path, "perhaps")


def refuse_by_file(path: Path) -> None:
    path.write_text("tracking: {photometric: {shrink: 0}}")
    load_config(path)


@pytest.mark.parametrize(
    ("make", "place"),
    [
        (lambda path: PhotometricSettings(shrink=0), "PhotometricSettings.shrink"),
        (lambda path: dataclasses.replace(PhotometricSettings(), shrink=0), "PhotometricSettings.shrink"),
        (lambda path: Config(tracking={"photometric": {"shrink": 0}}), "tracking.photometric.shrink"),  # type: ignore[arg-type]
        (lambda path: load_config(None, ["tracking.photometric.shrink=0"]), "`overrides`: tracking.photometric.shrink"),
        (refuse_by_file, "tracking.photometric.shrink"),
    ],
)
def test_every_way_to_a_setting_is_checked(tmp_path: Path, make: Callable[[Path], object], place: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make(tmp_path / "mine.yaml")
    assert str(caught.value).endswith(f"{place}: expected 1 to 16, found 0") and "\n" not in str(caught.value)


def test_groups_are_made_from_dictionaries() -> None:
    config = Config(mapping={"iterations_per_frame": 2}, tracking={"noise": {"constant": 0.01}})  # type: ignore[arg-type]
    assert config.mapping.iterations_per_frame == 2 and config.tracking.noise == DepthNoise(0.01)
    assert config.mapping.loss.depth_weight == 0.6  # what was not named keeps the default of the whole


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sed": 3}, "unknown setting sed; did you mean seed?"),
        (
            {"mapping": {"iterations": 3}},
            "unknown setting mapping.iterations; did you mean mapping.iterations_per_frame?",
        ),
        ({"loops": {"places": {"fern": 3}}}, "unknown setting loops.places.fern; did you mean loops.places.ferns?"),
        ({"loops": 3}, "loops: expected names with values, found 3"),
        ({"seed": 2.5}, "seed: expected a whole number, 0 to 9223372036854775807, found 2.5"),
        (
            {"tracking": {"points": {"max_depth": 0.05}}},
            "tracking.points.max_depth: expected more than min_depth, 0.1, found 0.05",
        ),
        ({"features": {"map": {"slots": 3}}}, "features.map.slots: expected a power of two, found 3"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Config(**values)
    assert str(caught.value) == message


def test_defaults_pass_their_own_checks() -> None:
    assert Config(**config_to_dict(Config())) == Config()
    for kind in OTHERS:
        assert kind(**yaml.safe_load(yaml.safe_dump(dataclasses.asdict(kind())))) == kind()


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().seed = 3  # type: ignore[misc]
