# SPDX-License-Identifier: Apache-2.0
"""What runs of a rig, on a GPU, with a memory limit or in real time cannot do: one table. A run refuses or notes it at
its start, and `ggslam doctor --modes` prints it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from operator import attrgetter

from ggslam.errors import ConfigError
from ggslam.slam.config import Config


class Mode(Enum):
    """A way of running that does less than a synchronous run of one camera on the CPU with all of the map in memory."""

    RIG = "a rig of cameras"
    GPU = "a GPU"
    PAGED = "a memory limit"
    REALTIME = "real time"


class Lack(Enum):
    """What happens to a capability that a mode lacks."""

    REFUSED = "refused"
    LEFT_OUT = "left out"
    AT_END = "at the end only"


@dataclass(frozen=True)
class Capability:
    """Something that a run can do.

    Attributes:
        name: for people.
        lacks: modes that do not have it, or not all of it.
        setting: that asks for it; "": it is asked for otherwise.
        is_wanted: whether the settings ask for it.
    """

    name: str
    lacks: dict[Mode, Lack]
    setting: str = ""
    is_wanted: Callable[[Config], bool] = field(default=lambda config: True)


_OUT, _NO = Lack.LEFT_OUT, Lack.REFUSED
CAPABILITIES = (
    Capability("real time", {Mode.RIG: _NO}, "realtime_fps", lambda c: c.realtime_fps > 0),
    Capability("a memory limit", {Mode.RIG: _NO, Mode.GPU: _NO}, "memory_limit_mb", lambda c: c.memory_limit_mb > 0),
    Capability("a GPU", {Mode.RIG: _NO, Mode.PAGED: _NO}, "device", lambda c: c.device == "cuda"),
    Capability("tracking by edges and planes", {Mode.RIG: _NO}, "tracker", lambda c: c.tracker != "gicp"),
    Capability(
        "a limit of time for edges and planes", {Mode.RIG: _OUT, Mode.GPU: _OUT}, "edges_planes.align.budget_ms",
        lambda c: c.tracker == "edges_planes" and c.edges_planes.align.budget_ms > 0,
    ),
    Capability("starting in the map of another run", {Mode.PAGED: _NO}),
    Capability("masking moving things", {Mode.RIG: _OUT}, "movers.enabled", lambda c: c.movers.enabled),
    Capability(
        "removing things from the map that start to move later", {Mode.RIG: _OUT, Mode.PAGED: _OUT}, "movers.enabled",
        lambda c: c.movers.enabled,
    ),
    Capability("masking what is fixed to the camera", {Mode.RIG: _OUT}),
    Capability("removing what is fixed to the camera from the map", {Mode.RIG: _OUT, Mode.PAGED: _OUT}),
    Capability(
        "starting a new part of the map with a lost camera", {Mode.RIG: _OUT, Mode.PAGED: _OUT},
        "tracking.recovery.new_part_after", lambda c: c.loops.enabled and c.tracking.recovery.new_part_after > 0,
    ),
    Capability(
        "correcting poses by colour where depth is wrong", {Mode.RIG: _OUT, Mode.REALTIME: Lack.AT_END},
        "mapping.view_alignment.enabled", lambda c: c.mapping.view_alignment.enabled,
    ),
    Capability(
        "colours that depend on the view, fitted after training", {Mode.PAGED: _OUT}, "sh_degree",
        lambda c: c.fits_view_colors,
    ),
    Capability(
        "training on frames in between where depth is exact",
        {Mode.RIG: _OUT, Mode.PAGED: _OUT, Mode.REALTIME: _OUT}, "mapping.exposure.enabled",
        lambda c: not c.mapping.exposure.enabled,
    ),
    Capability(
        "objects as colours", {Mode.GPU: _NO}, "identity.schedule",
        lambda c: c.identity.enabled and c.identity.schedule == "colors",
    ),
    Capability(
        "cloning and splitting Gaussians", {Mode.GPU: _OUT}, "mapping.densification",
        lambda c: c.mapping.densification != "never",
    ),
    Capability("pruning hidden Gaussians where depth is noisy", {Mode.REALTIME: Lack.AT_END}),
    Capability("checkpoints and `resume`", {Mode.GPU: _OUT, Mode.PAGED: _OUT, Mode.REALTIME: _OUT}),
    Capability("repeating bit for bit", {Mode.GPU: _OUT, Mode.REALTIME: _OUT}),
)  # fmt: skip
"""All that some mode lacks."""


def modes_of(config: Config, is_rig: bool, on_device: bool) -> list[Mode]:
    """The modes of a run.

    Args:
        config: its settings.
        is_rig: whether its recording is of several cameras.
        on_device: whether it computes on a GPU.
    """
    active = {
        Mode.RIG: is_rig, Mode.GPU: on_device, Mode.PAGED: config.memory_limit_mb > 0,
        Mode.REALTIME: config.realtime_fps > 0,
    }  # fmt: skip
    return [mode for mode, is_active in active.items() if is_active]


def refuse(mode: Mode, config: Config) -> None:
    """Raises ConfigError if the settings ask for something that a mode refuses."""
    for one in CAPABILITIES:
        if one.lacks.get(mode) is Lack.REFUSED and one.setting and one.is_wanted(config):
            value = attrgetter(one.setting)(config)
            raise ConfigError(f"{one.setting}: {value}: {mode.value} cannot be combined with {one.name}")


def notes(modes: Sequence[Mode], config: Config) -> list[str]:
    """What the settings of a run ask for and its modes leave out, one line for each mode."""
    found = []
    for mode in modes:
        wanted = [one for one in CAPABILITIES if one.is_wanted(config)]
        for lack, words in ((Lack.LEFT_OUT, "does not support"), (Lack.AT_END, "postpones to the end")):
            names = [one.name for one in wanted if one.lacks.get(mode) is lack]
            if names:
                found.append(f"{mode.value} {words}: {'; '.join(names)}")
    return found


def table() -> list[list[str]]:
    """The table for people: a row of headings, then a row for each capability."""
    rows = [["", *(mode.value for mode in Mode)]]
    for one in CAPABILITIES:
        rows.append([one.name, *(one.lacks[mode].value if mode in one.lacks else "yes" for mode in Mode)])
    return rows
