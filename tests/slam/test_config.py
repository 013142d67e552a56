# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml

from ggslam.errors import ConfigError
from ggslam.slam.config import (
    RETIRED,
    Config,
    OldNameWarning,
    config_from_dict,
    config_to_dict,
    load_config,
    presets,
    save_config,
    settings_notes,
)
from ggslam.system.settings import walk_public


def test_round_trip_through_yaml(tmp_path: Path) -> None:
    config = load_config(None, ["seed=7", "mapping.insertion.opacity=0.25", "tracking.points.count=4000"])
    save_config(config, tmp_path / "config.yaml")
    again = load_config(tmp_path / "config.yaml")
    assert again == config
    assert again.seed == 7 and again.mapping.insertion.opacity == 0.25 and again.tracking.points.count == 4000


def test_a_file_holds_public_settings_and_changed_internal_ones(tmp_path: Path) -> None:
    config = load_config(None, ["tracking.align.min_matches=77", "loops.graph.turn_length=2.5"])
    save_config(config, tmp_path / "config.yaml")
    assert load_config(tmp_path / "config.yaml") == config
    written = leaves(yaml.safe_load((tmp_path / "config.yaml").read_text()))
    public = {one.path for one in walk_public(Config) if not one.path.startswith("tracking.noise.")}
    assert written.keys() == public | {"tracking.align.min_matches", "loops.graph.turn_length"}


def test_files_with_all_settings_are_read(tmp_path: Path) -> None:
    config = load_config(None, ["mapping.rates.beta1=0.8"])
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config_to_dict(config)))
    assert load_config(tmp_path / "config.yaml") == config


def test_retired_names_are_read_and_told_of(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("loops: {revisits: {rest: 3}, confirmations: 4}")
    overrides = ["mapping.rates.features=0.5", "mapping.rates.beta1=0.8"]
    config = load_config(mine, overrides)
    usual = Config()
    assert config.loops == dataclasses.replace(usual.loops, confirmations=4)
    assert config.mapping.rates == dataclasses.replace(usual.mapping.rates, beta1=0.8)
    internal, retired = settings_notes(config, mine, overrides)
    assert "mapping.rates.beta1" in internal and "features" not in internal
    assert all(name in retired for name in RETIRED)
    assert settings_notes(load_config("fast-cpu"), "fast-cpu") == []
    with pytest.raises(ConfigError):
        load_config(None, ["loops.revisits.rests=3"])


def test_defaults_survive_the_dictionary() -> None:
    assert config_from_dict(config_to_dict(Config())) == Config()


def test_default_is_the_default() -> None:
    assert load_config("default") == Config()


def leaves(values: dict[str, Any], path: str = "") -> dict[str, Any]:
    """Settings by their full names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= leaves(value, f"{path}{name}.") if isinstance(value, dict) else {path + name: value}
    return found


@pytest.mark.parametrize("name", sorted(set(presets()) - {"default"}))
def test_presets_are_short_explained_and_change_what_they_list(name: str) -> None:
    text = presets()[name].read_text()
    usual, changed = leaves(config_to_dict(Config())), leaves(config_to_dict(load_config(name)))
    listed = leaves(yaml.safe_load(text))
    assert {key for key in usual if usual[key] != changed[key]} == set(listed)  # nothing else, and nothing in vain
    lines = text.splitlines()
    assert lines[0].startswith("# ") and len(lines) <= 15
    assert all("#" in line for line in lines if not line.endswith(":"))


def test_the_presets_are_told_of() -> None:
    assert set(presets()) == {"default", "fast-cpu", "quality-cpu", "gpu", "replica", "tum"}
    page = Path(__file__).parents[2] / "docs" / "presets.md"
    if page.is_file():  # a checkout
        assert all(f"| `{name}` |" in page.read_text() for name in presets())


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("mapping.iteration_per_frame=3", ["mapping.iteration_per_frame", "mapping.iterations_per_frame"]),
        ("seeed=3", ["seeed", "did you mean seed"]),
        ("seed=many", ["seed", "many"]),
        ("mapping=3", ["mapping", "3"]),
        ("mapping.seed.x=3", ["mapping.seed"]),
        ("sh_degree=5", ["sh_degree", "-1 to 3", "5"]),
        ("mapping.loss.dssim_weight=2", ["dssim_weight", "2"]),
        ("mapping.iterations_per_frame=-1", ["iterations_per_frame", "-1"]),
        ("seed", ["name=value"]),
    ],
)
def test_bad_settings_are_refused_by_name(override: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, [override])
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_bad_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no_such_preset"):
        load_config("no_such_preset")
    path = tmp_path / "broken.yaml"
    path.write_text("mapping: [1, 2")
    with pytest.raises(ConfigError, match="broken.yaml"):
        load_config(path)
    path.write_text("mapping: {insertion: {opacity: high}}")
    with pytest.raises(ConfigError, match=r"broken.yaml: mapping.insertion.opacity"):
        load_config(path)
    path.write_text("- 1\n- 2\n")
    with pytest.raises(ConfigError, match="broken.yaml"):
        load_config(path)


@pytest.mark.parametrize("overrides", ["seed=3", {"seed": 3}])
def test_overrides_that_are_no_list(overrides: Any) -> None:
    with pytest.raises(ConfigError, match="`overrides`"):
        load_config(None, overrides)


def test_the_old_name_of_a_tracker_is_read_and_said() -> None:
    """`features` of earlier versions, in --set and in files of settings, is `edges_planes`."""
    with pytest.warns(OldNameWarning) as said:
        given = ["tracker=features", "features.align.budget_ms=3", "edges_planes.map.edge_voxel=0.25"]
        config = load_config(None, given)
    assert config.tracker == "edges_planes" and len(said) == 2
    assert config.edges_planes.align.budget_ms == 3 and config.edges_planes.map.edge_voxel == 0.25
    old = {"tracker": "features", "features": {"align": {"budget_ms": 3, "edges": 70}}}
    both = {**old, "edges_planes": {"align": {"budget_ms": 5}}}
    assert config_from_dict(old).edges_planes.align.budget_ms == 3
    found = config_from_dict(both).edges_planes.align
    assert (found.budget_ms, found.edges) == (5, 70)  # the new name counts where both are given
    assert "features" not in config_to_dict(config_from_dict(old)) and set(old) == {"tracker", "features"}
    with pytest.raises(ConfigError):
        config_from_dict({"features": {"nonsense": 1}})
