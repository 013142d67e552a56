# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from ggslam.config import Config, config_from_dict, config_to_dict, load_config, presets, save_config
from ggslam.errors import ConfigError


def test_round_trip_through_yaml(tmp_path: Path) -> None:
    config = load_config(None, ["seed=7", "mapping.insertion.opacity=0.25", "tracking.points.count=4000"])
    save_config(config, tmp_path / "config.yaml")
    again = load_config(tmp_path / "config.yaml")
    assert again == config
    assert again.seed == 7 and again.mapping.insertion.opacity == 0.25 and again.tracking.points.count == 4000


def test_defaults_survive_the_dictionary() -> None:
    assert config_from_dict(config_to_dict(Config())) == Config()


def test_every_preset_loads() -> None:
    assert {"default", "fast", "quality"} <= set(presets())
    for name in presets():
        assert isinstance(load_config(name), Config)
    assert load_config("default") == Config()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("mapping.iteration_per_frame=3", ["mapping.iteration_per_frame", "mapping.iterations_per_frame"]),
        ("seeed=3", ["seeed", "did you mean seed"]),
        ("seed=many", ["seed", "many"]),
        ("mapping=3", ["mapping", "3"]),
        ("mapping.seed.x=3", ["mapping.seed"]),
        ("sh_degree=5", ["sh_degree", "0 to 3", "5"]),
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
