# SPDX-License-Identifier: Apache-2.0
"""The cases of field.py: small inputs from public bug reports, the smallest command of each, and what is right."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import GgslamError
from ggslam.runs.folder import RunFolder

NUMBER = r"([-+]?[0-9]*\.?[0-9]+)"


@dataclass(frozen=True)
class Outcome:
    """What a command printed, its exit code, and the folder of its run (which may not be there)."""

    text: str
    code: int
    run: Path

    def figure(self, name: str) -> float | None:
        """A figure of the run: "ATE" cm, "PSNR" dB and "depth" cm of held-out frames, "lost" and "frames"; None: there
        is none."""
        try:
            folder = RunFolder.open(self.run)
            metrics, frames = folder.metrics(), folder.keyframes().frames
        except GgslamError:
            return None
        if name == "frames":
            return float(len(frames))
        if name == "lost":
            return float(sum(frame.is_lost for frame in frames))
        keys, factor = {
            "ATE": (("trajectory", "ate_rmse_m"), 100.0), "PSNR": (("images", "held_out", "psnr"), 1.0),
            "depth": (("images", "held_out", "depth_l1_m"), 100.0),
        }[name]  # fmt: skip
        value = None if metrics is None else metrics.number(*keys)
        return None if value is None else factor * value


@dataclass(frozen=True)
class Says:
    """A sentence that must be printed, as a regular expression; case does not matter."""

    pattern: str

    def found(self, outcome: Outcome) -> str | None:
        """The line that has it; None: there is none."""
        lines = [line.strip() for line in outcome.text.splitlines()]
        return next((line for line in lines if re.search(self.pattern, line, re.IGNORECASE)), None)

    def met(self, outcome: Outcome) -> bool:
        """Whether it is there."""
        return self.found(outcome) is not None

    def value(self, outcome: Outcome) -> str:
        """Nothing: a sentence is no value."""
        return ""


@dataclass(frozen=True)
class Between:
    """A number that must lie between two: a figure of a run, or the group of a regular expression in the text."""

    what: str
    low: float
    high: float

    def _number(self, outcome: Outcome) -> float | None:
        if "(" not in self.what:
            return outcome.figure(self.what)
        found = re.search(self.what, outcome.text)
        return None if found is None else float(found[1])

    def met(self, outcome: Outcome) -> bool:
        """Whether it is there, and does."""
        number = self._number(outcome)
        return number is not None and self.low <= number <= self.high

    def value(self, outcome: Outcome) -> str:
        """For the table."""
        number = self._number(outcome)
        name = f"{self.what} " if "(" not in self.what else ""
        return "" if number is None else f"{name}{number:.4g}"


@dataclass(frozen=True)
class Ends:
    """The exit code."""

    code: int

    def met(self, outcome: Outcome) -> bool:
        """Whether it is this."""
        return outcome.code == self.code

    def value(self, outcome: Outcome) -> str:
        """For the table."""
        return f"exit code {outcome.code}"


Check = Says | Between | Ends


@dataclass(frozen=True)
class Case:
    """One input.

    Attributes:
        name: its folder, below `below`.
        words: of `ggslam`, or of Python after "-c"; {case} is its folder, {data} the folder of all.
        right: what is right, for people.
        named: it is met if the mistake is named...
        mended: ...or if all of these hold.
        label: what tells it from another case of this folder.
    """

    name: str
    words: tuple[str, ...]
    right: str
    named: Says | None = None
    mended: tuple[Check, ...] = ()
    below: str = "recordings"
    label: str = ""

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.name} {self.label}".strip()

    def command(self, data: Path, out: Path) -> list[str]:
        """The words of the process that runs it."""
        places = {"{case}": str(data / self.below / self.name), "{data}": str(data)}
        words = list(self.words)
        for name, place in places.items():
            words = [word.replace(name, place) for word in words]
        if words[0] == "-c":
            return [sys.executable, *words]
        more = ["--out", str(out), "--overwrite"] if words[0] in ("run", "localize") else []
        return [sys.executable, "-m", "ggslam", *words, *(more if words[0] == "run" else more[:2])]

    def met(self, outcome: Outcome) -> bool:
        """Whether it is."""
        named = self.named is not None and self.named.met(outcome)
        return named or (bool(self.mended) and all(check.met(outcome) for check in self.mended))

    def said(self, outcome: Outcome) -> str:
        """The sentence that names it, else the error, else the first warning."""
        found = None if self.named is None else self.named.found(outcome)
        for pattern in (r"^error", r"^wrong:", r"^(warning|doubtful:)"):
            found = found or Says(pattern).found(outcome)
        return found or ""

    def value(self, outcome: Outcome) -> str:
        """The figures that count."""
        return ", ".join(text for check in self.mended if (text := check.value(outcome)))


def naming(pattern: str) -> Says:
    """A line in which ggslam names a mistake."""
    return Says(rf"^(?:error|warning|wrong|doubtful|note)\b.*(?:{pattern})")


def _run(*more: str) -> tuple[str, ...]:
    return ("run", "{case}", "--stop", "20", *more)


_INSPECT = ("inspect", "{case}")
_CAMERA = Says(r"camera\s+160x120, fx 120\.00 fy 120\.00 cx 79\.50 cy 59\.50")
_SHARP = (Between("PSNR", 31.0, 99.0), Between("ATE", 0.0, 0.3))
_CALIBRATED = ("inspect", "{data}/recordings/no_yaml", "--format", "folder", "--depth-scale", "5000", "--camera")


def _calibration(file: str, of: str) -> Case:
    words = (*_CALIBRATED, f"{{case}}/{file}")
    return Case("calibrations", words, "160x120, 120 120 79.5 59.5", mended=(_CAMERA,), label=of)


def _count(name: str, file: str, code: str, right: str, low: int, high: int) -> Case:
    """A file of points or Gaussians, and how many are read."""
    words = ("-c", f"import ggslam; {code.format(file=f'{{case}}/{file}')}")
    return Case(name, words, right, mended=(Between(rf"read {NUMBER}", low, high),), below="maps", label=file)


_POINTS = (
    "from ggslam.formats.point_cloud import read_point_cloud as r; import numpy as n; c = r('{file}'); "
    "print('read', int(n.isfinite(c.points).all(1).sum()))"
)
_SCAN = (
    "from pathlib import Path; from ggslam.formats.cloud_files import read_cloud_file as r; "
    "print('read', len(r(Path('{file}')).points))"
)
_SPLATS = (
    "g = ggslam.read_splats('{file}'); import torch as t; "
    "ok = all(bool(t.isfinite(a).all()) for a in (g.means, g.scales, g.opacities)); "
    "print('read', len(g) if ok else -1)"
)
_TURN = """
import ggslam, numpy, torch
camera = ggslam.Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
gaussians = ggslam.read_splats("{case}/deg2.ply")
a, b = numpy.radians(90.0), numpy.radians(-35.0)
turn, tilt, T = numpy.eye(4), numpy.eye(4), numpy.eye(4)
turn[:2, :2] = [[numpy.cos(a), -numpy.sin(a)], [numpy.sin(a), numpy.cos(a)]]
tilt[1:3, 1:3] = [[numpy.cos(b), -numpy.sin(b)], [numpy.sin(b), numpy.cos(b)]]
start, T = numpy.eye(4), turn @ tilt
start[:3, 3] = gaussians.means.mean(0).numpy() - [0.0, 0.0, 3.0]
before = ggslam.render(gaussians, camera, T_world_camera=start).image.clone()
gaussians.move(torch.ones(len(gaussians), dtype=torch.bool), torch.from_numpy(T))
after = ggslam.render(gaussians, camera, T_world_camera=T @ start).image
print(f"drawn {float(before.max()):.2f}, turned along: differs by {float((before - after).abs().max()):.4f}")
"""
_ALL_FOUND = Between(rf"frames located\D*{NUMBER}", 100, 100)
_LOCALIZE = ("localize", "{case}/map.ply", "{case}", "--full-map", "--start-pose", "given", "--columns", "3")

CASES = (
    Case("d435_unregistered", _INSPECT, "depth is not registered: enlarge 1.6 times",
         naming(r"not registered|enlarge.*1\.[56]|1\.6 times")),
    Case("d435_unregistered", _run("--depth-camera", "{data}/recordings/calibrations/d435_0.015.yaml"),
         "with its calibration: no run that is bad", mended=(Says(r"^verdict: (good|doubtful)"),), label="calibrated"),
    Case("kitti00_learned_depth", _INSPECT, "depth scale near 470",
         mended=(Between(rf"--depth-scale {NUMBER}", 400, 550),)),
    Case("kitti00_learned_depth", _run(), "lost: exit code 1; or located", Says(r"error: .*lost in"),
         (Between("lost", 0, 2),), label="run"),
    Case("kinect_corner", ("run", "{case}"), "control: 3 of 22 lost, and not bad",
         mended=(Between("lost", 0, 4), Says(r"^verdict: (good|doubtful)"))),
    Case("saturated", _run(), "32.1 dB, depth 1.1 cm, ATE 0.17 cm", mended=(*_SHARP, Between("depth", 0, 2.5))),
    Case("onebased", _run("--skip-bad-frames"), "n with n+1, or said to be a frame off",
         naming(r"(one|a|1) frame off|numbered from 1|(one|1) frame (later|earlier|after|before)"),
         (Between("ATE", 0.0, 0.3),)),
    Case("npy_depth", _INSPECT, "read, 1 unit a metre", mended=(Says(r"depth\s.*\b1 units? a metre"),)),
    _calibration("orb.yaml", "ORB-SLAM"), _calibration("ros.yaml", "ROS camera_info"),
    _calibration("ros_opencv.yaml", "OpenCV"), _calibration("open3d.json", "Open3D"), _calibration("K.txt", "matrix"),
    Case("no_yaml", (*_INSPECT, "--intrinsics", "120 120 79.5 59.5", "--depth-scale", "5000"),
         "as with --format folder", mended=(_CAMERA,)),
    Case("rtabmap_export", _INSPECT, "K of calib/, poses with ids", mended=(_CAMERA, Says(r"poses\s+\d+ frames"))),
    Case("ray_depth", _INSPECT, "z = d / sqrt(1 + x² + y²): consistency 0.5 %", naming(r"along the ray|ray depth"),
         (Between(rf"agrees with the poses to {NUMBER}%", 0, 0.7),)),
    Case("ray_depth", _run(), "located to some mm", naming(r"along the ray|ray depth"), (Between("ATE", 0, 1.0),),
         label="run"),
    Case("mirror_depth", _INSPECT, "depth is mirrored", naming(r"mirror")),
    Case("exif3", _INSPECT, "colour is stored turned by its tag", naming(r"turned|orientation|rotat")),
    Case("exif6", _INSPECT, "colour is stored turned by its tag", naming(r"turned|orientation|rotat")),
    Case("inverse_depth", _INSPECT, "depth is inverse (disparity)", naming(r"inverse|disparity")),
    Case("scale_inverse", _INSPECT, "5000 = 1 / 0.0002", naming(r"depth.scale.* 5000\b"),
         (Says(r"5000 units a metre"),)),
    Case("tum_gt_otherclock", ("run", "{case}", "--no-eval"), "runs without truth, with a warning",
         mended=(Ends(0), Says(r"(warning|note).*(pose|truth|clock|time)"))),
    Case("tum_slowdepth", _INSPECT, "colour images without depth are left out",
         naming(r"\d+ of \d+ colour images .*left out")),
    Case("kitti_fewer", ("run", "{case}", "--stop", "15"), "runs, truth for 15",
         mended=(Ends(0), Between("frames", 15, 15), Between("ATE", 0, 5))),
    Case("shift1", _run(), "a frame off; true pairs: 32.46 dB, 0.16 cm",
         naming(r"(one|a|1) frame (off|later|earlier|after|before)|frames? after it"), _SHARP),
    Case("dark_start", _run(), "map as bright as most frames: 32 dB", mended=(Between("PSNR", 31, 99),)),
    Case("lidar_radius", _LOCALIZE, "both scans located", mended=(_ALL_FOUND,), below="maps"),
    Case("utm_map", _LOCALIZE, "both scans located", mended=(_ALL_FOUND,), below="maps"),
    _count("pcd_count0", "ouster_count0.pcd", _POINTS, "500 points", 500, 500),
    _count("pcd_upper_xyz", "upper.pcd", _POINTS, "500 points", 500, 500),
    _count("ply_nan", "nan_binary.ply", _POINTS, "428 points", 428, 428),
    _count("ply_nan", "nan_ascii.ply", _POINTS, "428 points", 428, 428),
    _count("splat_bad_vertex", "neginf.ply", _SPLATS, "read without the bad ones", 1, 10**6),
    _count("splat_bad_vertex", "inf_opacity.ply", _SPLATS, "read without the bad ones", 1, 10**6),
    _count("splat_bad_vertex", "nan_opacity.ply", _SPLATS, "read without the bad ones", 1, 10**6),
    _count("splat_bad_vertex", "zero_quat.ply", _SPLATS, "read without the bad ones", 1, 10**6),
    _count("splat_bad_vertex", "2dgs.ply", _SPLATS, "read, flat ones clamped", 1, 10**6),
    _count("nuscenes_columns", "000000.pcd.bin", _SCAN, "16000 points of five columns", 16000, 16000),
    Case("utm_map", ("-c", "exec(open('{case}/tsdf_mesh.py').read())"), "38 distinct y",
         mended=(Between(rf"463000.*x lattice distinct {NUMBER}", 38, 38),), below="maps", label="mesh"),
    Case("sh_turn", ("-c", _TURN), "colours turn along: 0.00",
         mended=(Between(rf"drawn {NUMBER}", 0.1, 9), Between(rf"differs by {NUMBER}", 0, 0.01)), below="maps"),
    Case("ghost_beyond_max_depth", ("-c", "exec(open('{case}/ghost.py').read())"), "free at 1.2 and 1.4 m",
         mended=(Between(rf"8 m \[{NUMBER}", 0.5, 99), Between(rf"117\) \[{NUMBER}", 0.5, 99)), below="maps"),
)  # fmt: skip
