# SPDX-License-Identifier: Apache-2.0
"""Which runs a batch makes: recordings x settings x seeds, from a manifest or a folder of recordings."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ggslam.errors import ConfigError, NotABatchError
from ggslam.sequences import recognise_format
from ggslam.slam.config import load_config
from ggslam.system.missing_paths import why_missing
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import given_path, is_plain_name, open_untrusted, read_untrusted_text

REPLICA = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
"""Replica's scenes in the order in which papers list them."""
_KEYS = {"out", "options", "recordings", "settings", "seeds", "baseline"}
ALLOWED = (
    "config", "set", "start", "stop", "stride", "scale", "format", "depth-scale", "pose-convention", "masks", "camera",
    "intrinsics", "depth-camera", "depth-kind", "depth-delay", "upright", "void-id", "min-confidence", "topic",
    "iterations", "refine", "realtime", "tracker", "device", "map", "loops", "no-loops", "threads", "skip-bad-frames",
    "no-skip-bad-frames", "check", "no-check", "strict", "energy", "checkpoint-every",
)  # fmt: skip
"""Options of `ggslam run` that a batch passes on: they say how a run is made. The others choose folders, write files of
their own (`--log`, `--record`), run code of others (`--loss`), serve pages, or are the batch's own business."""


class ManifestTuning(Tuning):
    """How a manifest is told from other files."""

    looked_at_bytes = 4096
    """Bytes at its begin in which there is no zero byte."""


@dataclass(frozen=True)
class BatchJob:
    """A run of a batch.

    Attributes:
        recording, settings: names, for the table.
        seed: of the run.
        words: arguments of `ggslam run` but for the output folder.
    """

    recording: str
    settings: str
    seed: int
    words: tuple[str, ...]

    @property
    def name(self) -> str:
        """Path of the run's folder within the batch's."""
        return f"{_file_name(self.recording)}/{_file_name(self.settings)}/seed{self.seed}"


@dataclass(frozen=True)
class Manifest:
    """A batch.

    Attributes:
        title: of its table.
        out: folder of its runs and tables.
        jobs: its runs, in the order of the table.
        baseline: settings that the file says to compare with.
    """

    title: str
    out: Path
    jobs: list[BatchJob] = field(default_factory=list)
    baseline: str | None = None

    def baseline_name(self, asked: str | None = None) -> str | None:
        """Settings that the others are compared with: the ones asked for, or those of the file, or the first of
        several.

        Raises:
            ConfigError: there are no settings of that name.
        """
        names = list(dict.fromkeys(job.settings for job in self.jobs))
        name = asked or self.baseline
        if name is None:
            return names[0] if len(names) > 1 else None
        if name not in names:
            raise ConfigError(f"`baseline`: expected one of the settings {', '.join(names)}, found {name}")
        return name


FLAGS = {
    "upright", "loops", "no-loops", "skip-bad-frames", "no-skip-bad-frames", "check", "no-check", "strict", "energy",
}  # fmt: skip
"""Those of them that take no value."""


def read_manifest(path: str | Path, out: Path | None = None, options: Sequence[str] = ()) -> Manifest:
    """Reads a batch's YAML; recordings in it are relative to it. docs/batch.md describes the file.

    A manifest may come from somebody else: it does not choose a folder outside its own or the working folder, and names
    no model to run. Who calls may do both.

    Args:
        path: of the file.
        out: folder of the batch; None: as the file says, or `runs/NAME`.
        options: of `ggslam run`, before the file's.

    Raises:
        ConfigError: it is not there, no plain YAML, or says something impossible; names the place.
    """
    path = Path(path)
    with open_untrusted(path, ConfigError) as file:
        if b"\0" in file.read(ManifestTuning.looked_at_bytes):
            raise NotABatchError(path, "is no manifest: it is not text")
    try:
        values = parse_yaml(read_untrusted_text(path, ConfigError))
    except PlainYamlError as error:
        raise ConfigError(f"{path}: {error}") from None
    if not isinstance(values, dict) or set(values) - _KEYS or "recordings" not in values:
        strange = [str(key)[:40] for key in values if key not in _KEYS] if isinstance(values, dict) else []
        found = f", found {', '.join(strange)}" if strange else ""
        raise NotABatchError(path, f"expected recordings and no other keys than {', '.join(sorted(_KEYS))}{found}")
    asked = tuple(_check_words("`options`", options))
    common = _options(path, "options", values.get("options"))
    items = _take_list(path, "recordings", values["recordings"])
    recordings = [_recording(path, k, item) for k, item in enumerate(items)]
    given = values.get("settings") or {"default": None}
    if not isinstance(given, dict):
        raise ConfigError(f"{path}: settings: expected names with options of `ggslam run`, found {given!r}")
    settings = {str(name): _options(path, f"settings.{name}", words) for name, words in given.items()}
    seeds = _take_list(path, "seeds", values.get("seeds", [0]))
    if not all(isinstance(seed, int) and not isinstance(seed, bool) and seed >= 0 for seed in seeds):
        raise ConfigError(f"{path}: seeds: expected whole numbers from 0 on, found {seeds!r}")
    folder = out or (_own_folder(path, str(values["out"])) if "out" in values else Path("runs") / path.stem)
    words = [(*common, *own, *chosen) for _, _, own in recordings for chosen in settings.values()]
    _refuse_models(str(path), asked, words)
    baseline = values.get("baseline")
    if baseline is not None and baseline not in settings:
        raise ConfigError(f"{path}: baseline: expected one of the settings {', '.join(settings)}, found {baseline!r}")
    return Manifest(path.stem, folder, _jobs(recordings, settings, seeds, (*asked, *common), str(path)), baseline)


def manifest_of_folder(
    folder: str | Path, out: Path | None = None, seeds: Sequence[int] = (0,), options: Sequence[str] = (),
    only: Iterable[str] | None = None,
) -> Manifest:  # fmt: skip
    """All recordings that a folder holds, with the same options.

    Args:
        folder: its subfolders are looked at.
        out: folder of the batch; None: `runs/NAME`.
        seeds: of each recording.
        options: of `ggslam run`.
        only: names of subfolders that have to be there (Replica's scenes); None: all that are recognised.

    Raises:
        ConfigError: no folder, or no recording in it.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise ConfigError(f"{folder}: {why_missing(folder, 'no such folder')}")
    wanted = sorted(path for path in folder.iterdir() if path.is_dir()) if only is None else [folder / n for n in only]
    found = [path for path in wanted if path.is_dir() and recognise_format(path)]
    if not found:
        names = "" if only is None else f" of the names {', '.join(wanted_name.name for wanted_name in wanted)}"
        raise NotABatchError(folder, f"holds no recording{names}")
    recordings = [(path.name, path, ()) for path in found]
    name = folder.resolve().name
    jobs = _jobs(recordings, {"default": ()}, seeds, tuple(_check_words(str(folder), options)), str(folder))
    return Manifest(name, out or Path("runs") / name, jobs)


def option(name: str) -> str:
    """An option of the command line."""
    return f"--{name}"


def _jobs(
    recordings: Sequence[tuple[str, Path, tuple[str, ...]]], settings: dict[str, tuple[str, ...]], seeds: Sequence[int],
    common: tuple[str, ...], where: str,
) -> list[BatchJob]:  # fmt: skip
    jobs = [
        BatchJob(name, setting, seed, (str(path), *common, *own, *words, option("seed"), str(seed)))
        for name, path, own in recordings for setting, words in settings.items() for seed in seeds
    ]  # fmt: skip
    folders = [job.name for job in jobs]
    if long := next((name for name in folders if not all(map(is_plain_name, name.split("/")))), None):
        raise ConfigError(f"{where}: a run's folder would have a name that is too long: {long[:60]}...")
    twice = sorted({name for name in folders if folders.count(name) > 1})
    if twice:
        raise ConfigError(f"{where}: two runs would have the folder {twice[0]}: give recordings and settings own names")
    if not jobs:
        raise ConfigError(f"{where}: names no run")
    return jobs


def _recording(path: Path, number: int, item: Any) -> tuple[str, Path, tuple[str, ...]]:
    where = f"recordings[{number}]"
    if isinstance(item, str):
        item = {"path": item}
    if not isinstance(item, dict) or set(item) - {"path", "name", "options"} or not isinstance(item.get("path"), str):
        raise ConfigError(f"{path}: {where}: expected a path, or path, name and options, found {item!r}")
    place = (path.parent / given_path(item["path"], ConfigError, f"{path}: {where}")).absolute()
    name = str(item.get("name") or place.resolve().name)
    return name, place, _options(path, f"{where}.options", item.get("options"))


def _own_folder(path: Path, out: str) -> Path:
    """The folder that a manifest names."""
    folder = path.parent / given_path(out, ConfigError, f"{path}: out")
    if not any(folder.resolve().is_relative_to(place.resolve()) for place in (path.parent, Path.cwd())):
        raise ConfigError(f"{path}: out: {out} lies outside the manifest's folder; choose it with {option('out')}")
    return folder


def _options(path: Path, where: str, words: Any) -> tuple[str, ...]:
    if words is None:
        return ()
    if not isinstance(words, str):
        raise ConfigError(f"{path}: {where}: expected options of `ggslam run` as one text, found {words!r}")
    try:
        return tuple(_check_words(f"{path}: {where}", shlex.split(words)))
    except ValueError as error:
        raise ConfigError(f"{path}: {where}: {error}") from None


def _check_words(where: str, words: Sequence[str]) -> Sequence[str]:
    """Raises ConfigError if there are options that a batch does not pass on."""
    for name, value in _pairs(words):
        if name not in map(option, ALLOWED):
            told = f"{name} is not for batches: folders, seeds, scores and pages are theirs"
            near = difflib.get_close_matches(name, [option(known) for known in ALLOWED], 1, 0.75)
            told += f"; did you mean {near[0]}?" if near else ""
            told = told if name.startswith("-") else f"expected an option, found {name[:80]!r}"
            raise ConfigError(f"{where}: {told}")
        if value is None and name[2:] not in FLAGS:
            raise ConfigError(f"{where}: {name} needs a value")
        if value is not None and value.startswith("--"):
            raise ConfigError(f"{where}: {name}: expected a value, found {value[:80]!r}, which looks like an option")
    return words


def _pairs(words: Sequence[str]) -> list[tuple[str, str | None]]:
    """Options with their values, as the command line takes them; None: a flag, or nothing follows."""
    found: list[tuple[str, str | None]] = []
    rest = list(words)
    while rest:
        name, equals, value = rest.pop(0).partition("=")
        if equals or name[2:] in FLAGS or not name.startswith("-"):
            found.append((name, value if equals else None))
        else:
            found.append((name, rest.pop(0) if rest else None))
    return found


def _refuse_models(where: str, asked: tuple[str, ...], runs: Iterable[tuple[str, ...]]) -> None:
    """Raises ConfigError if options in a file, after those that who calls has asked for, choose another model of masks:
    a model is run like a program."""
    own = _model_of(asked)
    if any(_model_of((*asked, *words)) not in (None, own) for words in dict.fromkeys(runs)):
        said = f"{option('options')} '{option('set')} masks.model=FILE'"
        raise ConfigError(f"{where}: names a model of masks, which is run like a program; name it yourself: {said}")


def _model_of(words: Sequence[str]) -> str | None:
    """The model of masks that options of `ggslam run` lead to, by themselves or through a file of settings; "": none,
    None: no run begins with these options."""
    given = {name: [v or "" for n, v in _pairs(words) if n == option(name)] for name in ("config", "set")}
    try:
        return load_config(given["config"][-1] if given["config"] else None, given["set"]).masks.model
    except ConfigError:
        return None


def model_of(words: Sequence[str]) -> str:
    """The model of masks of a job, by its words: a recording and options; "": none."""
    return _model_of(words[1:]) or ""


def _take_list(path: Path, where: str, values: Any) -> list[Any]:
    if not isinstance(values, list) or not values:
        raise ConfigError(f"{path}: {where}: expected a list, found {values!r}")
    return values


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "_"
