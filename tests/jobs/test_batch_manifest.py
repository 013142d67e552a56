# SPDX-License-Identifier: Apache-2.0
"""Which runs a manifest, or a folder of recordings, makes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import typer

from ggslam.cli.main import app
from ggslam.errors import ConfigError
from ggslam.jobs.batch.manifest import ALLOWED, FLAGS, REPLICA, manifest_of_folder, read_manifest

MANIFEST = """
out: tables/first
options: --scale 0.5
recordings:
  - kitchen
  - {path: /data/office 3, name: office3, options: --stop 100}
settings:
  default: ""
  "one step": --iterations 1
seeds: [0, 7]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "experiments.yaml"
    path.write_text(text)
    return path


def test_recordings_times_settings_times_seeds(tmp_path: Path) -> None:
    found = read_manifest(written(tmp_path, MANIFEST))
    assert (found.title, found.out) == ("experiments", tmp_path / "tables/first")
    names = [job.name for job in found.jobs]
    assert names == [
        f"{recording}/{settings}/seed{seed}"
        for recording in ("kitchen", "office3") for settings in ("default", "one_step") for seed in (0, 7)
    ]  # fmt: skip
    assert found.jobs[0].words == (str(tmp_path / "kitchen"), "--scale", "0.5", "--seed", "0")
    last = ("/data/office 3", "--scale", "0.5", "--stop", "100", "--iterations", "1", "--seed", "7")
    assert found.jobs[-1].words == last and found.jobs[-1].settings == "one step"


def test_a_short_manifest(tmp_path: Path) -> None:
    found = read_manifest(written(tmp_path, "recordings: [a]"), tmp_path / "here")
    assert [job.name for job in found.jobs] == ["a/default/seed0"] and found.out == tmp_path / "here"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("recordings: []", r"recordings.*\[\]"),
        ("seeds: [1]", "options, out, recordings, seeds, settings"),
        ("recordings: [a]\nworkers: 3", "options, out, recordings, seeds, settings"),
        ("recordings: [{name: b}]", r"recordings\[0\].*'name': 'b'"),
        ("recordings: [a]\nseeds: [-1]", r"seeds.*\[-1\]"),
        ("recordings: [a]\nseeds: [true]", r"seeds.*\[True\]"),
        ("recordings: [a]\nsettings: [x]", r"settings.*\['x'\]"),
        ("recordings: [a]\nsettings: {x: --out b}", r"settings\.x.*--out"),
        ("recordings: [a]\noptions: --seed=3", "options.*--seed"),
        ("recordings: [a]\noptions: 'unclosed \"'", "options: "),
        ("recordings: [a]\noptions: [x]", r"options.*\['x'\]"),
        ("recordings: [a]\noptions: --log=x.rrd", "options.*--log"),
        ("recordings: [a]\nsettings: {x: --record b}", r"settings\.x.*--record"),
        ("recordings: [{path: a, options: -h}]", r"recordings\[0\]\.options.* -h\b"),
        ("recordings: [a]\noptions: --help-settings", "options.*--help-settings"),
        ("recordings: [a]\noptions: --set masks.model=a.onnx", r"masks\.model"),
        ("recordings: [a]\nsettings: {x: '--set=masks.model=a.onnx'}", r"masks\.model"),
        ("recordings: [{path: a, options: --config own.yaml}]", r"masks\.model"),
        ("recordings: [a]\nout: ../elsewhere", r"out.*\.\./elsewhere.*--out"),
        ("recordings: [a]\nout: /elsewhere", "out: /elsewhere.*--out"),
        ("recordings: [a]\nout: linked/elsewhere", "out.*linked/elsewhere.*--out"),
        ("recordings: [a, b/a]", "a/default/seed0"),
        ("recordings: [a", "experiments.yaml: "),
        ('recordings: [{path: "a\\0b"}]', r"recordings\[0\].*a\\x00b"),
        ('recordings: [a]\nout: "x\\0y"', r"out.*x\\x00y"),
        (f"recordings: [{'a' * 5000}]", "a{60}...'.*5,000"),
        (f"recordings: [a]\nout: {'x' * 300}", "x{60}...'.*300"),
        (f"recordings: [a]\nout: {'x/' * 2048}y", "out.*4,097"),
        (f"recordings: [{{path: a, name: {'n' * 300}}}]", "n{60}...$"),
        (f"recordings: [a]\nsettings: {{{'s' * 300}: ''}}", "a/s{58}...$"),
        (f"recordings: [a]\nseeds: [1{'0' * 300}]", "a/default/seed10{45}...$"),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, text: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.yaml").write_text("masks: {model: a.onnx}")
    (tmp_path / "linked").symlink_to(tmp_path_factory.mktemp("other"))
    with pytest.raises(ConfigError, match=words):
        read_manifest(written(tmp_path, text))


def test_a_manifest_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        read_manifest(tmp_path / "none.yaml")


def test_all_recordings_of_a_folder(room: Path, tmp_path: Path) -> None:
    for name in ("b", "room0", "office1"):
        shutil.copytree(room, tmp_path / name, ignore=shutil.ignore_patterns("masks"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no recording")
    found = manifest_of_folder(tmp_path, seeds=(0, 1), options=("--stop", "5"))
    names = [f"{name}/default/seed{seed}" for name in ("b", "office1", "room0") for seed in (0, 1)]
    assert [job.name for job in found.jobs] == names
    assert found.jobs[0].words == (str(tmp_path / "b"), "--stop", "5", "--seed", "0")
    replica = manifest_of_folder(tmp_path, only=REPLICA)
    assert [job.recording for job in replica.jobs] == ["room0", "office1"]  # in the order of papers
    for folder in (tmp_path / "empty", tmp_path / "nothing"):
        with pytest.raises(ConfigError, match=folder.name):
            manifest_of_folder(folder)


def test_who_calls_may_name_a_model_and_any_folder(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    path, elsewhere = written(tmp_path, "recordings: [a]\noptions: --scale 0.5"), tmp_path_factory.mktemp("other")
    asked = ["--set", "masks.model=a.onnx"]
    found = read_manifest(path, elsewhere, asked)
    assert found.out == elsewhere
    assert found.jobs[0].words[1:5] == ("--set", "masks.model=a.onnx", "--scale", "0.5")
    with pytest.raises(ConfigError, match=r"masks\.model"):  # the file's own is another one
        read_manifest(written(tmp_path, "recordings: [a]\noptions: --set masks.model=b.onnx"), None, asked)


def test_every_option_of_a_run_is_passed_on_or_refused_on_purpose() -> None:
    run = typer.main.get_command(app).commands["run"]  # type: ignore[attr-defined]
    options = [parameter for parameter in run.params if parameter.param_type_name == "option"]
    names = {name.lstrip("-") for option in options for name in (*option.opts, *option.secondary_opts)}
    refused = {
        "out", "seed", "resume", "overwrite", "view", "host", "port", "eval", "no-eval", "localize-only", "log",
        "record", "help-setting", "help-settings", "loss", "encode", "encode-with", "middleware", "domain", "namespace",
        "address", "publish",
    }  # fmt: skip
    assert names - set(ALLOWED) == refused and set(ALLOWED) <= names
    flags = {n.lstrip("-") for option in options if option.is_flag for n in (*option.opts, *option.secondary_opts)}
    assert flags & set(ALLOWED) == FLAGS


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--set masks.model=a.onnx --camera --set=masks.model=", "--camera.*'--set="),
        ("--config own.yaml --masks --config=plain.yaml", "--masks.*'--config=plain.yaml'"),
        ("--set", "options: --set"),
        ("--scale 0.5 elsewhere", "options.*'elsewhere'"),
        ("--strict elsewhere", "options.*'elsewhere'"),
        ("-- --scale 0.5", "options: -- "),
    ],
)
def test_no_option_hides_behind_another(tmp_path: Path, options: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        read_manifest(written(tmp_path, f"recordings: [a]\noptions: '{options}'"))


def test_numbers_below_zero_are_values(tmp_path: Path) -> None:
    found = read_manifest(written(tmp_path, "recordings: [a]\noptions: --depth-delay -0.5 --no-check"))
    assert found.jobs[0].words[1:4] == ("--depth-delay", "-0.5", "--no-check")
