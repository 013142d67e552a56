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
from ggslam.jobs.localize.settings import LocalizeSettings
from ggslam.localization.frames import LookUpSettings
from ggslam.objects.inpainting import InpaintSettings
from ggslam.objects.membership import MembershipSettings
from ggslam.slam.config import Config, config_to_dict, load_config
from ggslam.system.settings import (
    Known,
    changed_tuning,
    setting,
    settings_class,
    tuning_class,
    tuning_note,
    walk,
    walk_public,
)
from ggslam.tracking.settings import DepthNoise, PhotometricSettings
from ggslam.volumes.safety import Braking

OTHERS = (
    AttributeSettings, CodecSettings, LookUpSettings, LocalizeSettings, InpaintSettings, MembershipSettings, Scanner,
    Braking,
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


def test_few_of_them_are_public() -> None:
    public = {one.path for kind in (Config, LocalizeSettings) for one in walk_public(kind)}
    assert 60 <= len(public) <= 90
    basic = {one.path for _, one in ALL if one.declaration.basic}
    assert 15 <= len(basic) <= 25 and basic <= public


@settings_class(frozen=True)
class Inner:
    """A group."""

    depth: float = setting(1.0, 0, 10, "m")
    """Depth of the group."""
    width: float = setting(2.0, 0, 10, "m")
    """Width of the group."""


@tuning_class(frozen=True)
class OuterTuning:
    """Internal numbers."""

    hidden: int = setting(3, 0, 10)
    """An internal number."""
    group: Inner = dataclasses.field(default_factory=lambda: Inner(depth=5.0))


@settings_class(frozen=True)
class Outer(OuterTuning):
    """Settings with internal numbers."""

    shown: int = setting(4, 0, 10)
    """A public number."""


def test_settings_inherit_their_tuning() -> None:
    outer = dataclasses.replace(Outer(shown=1), hidden=7)
    assert (outer.shown, outer.hidden, outer.group) == (1, 7, Inner(5.0, 2.0))
    assert [one.path for one in walk(Outer) if one.internal] == ["hidden"]
    assert {one.path: one.text for one in walk(Outer)}["hidden"] == "An internal number."
    assert changed_tuning(outer) == ["hidden"] and tuning_note(Outer(shown=1)) == ""
    with pytest.raises(ConfigError):
        Outer(hidden=11)


def test_a_group_keeps_the_defaults_of_the_whole() -> None:
    assert Outer(group={"width": 9.0}).group == Inner(5.0, 9.0)  # type: ignore[arg-type]
    given = load_config(None, ["mapping.loss.dssim_weight=0.1", "volumes.occupancy.probability_occupied=0.6"])
    usual = Config()
    assert given.mapping.loss == dataclasses.replace(usual.mapping.loss, dssim_weight=0.1)
    assert given.volumes.occupancy == dataclasses.replace(usual.volumes.occupancy, probability_occupied=0.6)


def test_internal_settings_are_given_and_told_of() -> None:
    told = 0
    for one in walk(Config):
        if not one.internal or not one.is_number:
            continue
        value = one.declaration.high if one.default != one.declaration.high else one.declaration.low
        try:
            config = build(Config, one.path, value)
        except ConfigError:
            continue  # contradicts another one
        assert changed_tuning(config) == [one.path] and one.path in tuning_note(config)
        told += 1
    assert told > 200


def test_unknown_names_are_answered_by_public_ones() -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, ["tracking.points.min_neighbour=0.5"])
    hint = str(caught.value).partition(";")[2]
    assert "tracking.points.min_neighbours" not in hint


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
        path = one.path if getattr(kind, "is_root", False) else f"{kind.__name__}.{one.path}"
        assert str(caught.value) == f"{path}: expected {one.range()}, found {value}"


@pytest.mark.parametrize("pair", [pair for pair in ALL if pair[1].choices or pair[1].kind is bool], ids=name)
def test_each_choice_is_refused_by_its_path(pair: tuple[type, Known]) -> None:
    kind, one = pair
    with pytest.raises(ConfigError, match=rf"{re.escape(one.path)}: .*'perhaps'"):
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
        ({"loops": {"confirmation": 3}}, "unknown setting loops.confirmation; did you mean loops.confirmations?"),
        ({"loops": {"places": {"fern": 3}}}, "unknown setting loops.places.fern"),
        ({"loops": 3}, "loops: expected names with values, found 3"),
        ({"seed": 2.5}, "seed: expected a whole number, 0 to 9223372036854775807, found 2.5"),
        (
            {"tracking": {"points": {"max_depth": 0.05}}},
            "tracking.points.max_depth: expected more than min_depth, 0.1, found 0.05",
        ),
        ({"edges_planes": {"map": {"slots": 3}}}, "edges_planes.map.slots: expected a power of two, found 3"),
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
