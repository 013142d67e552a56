# SPDX-License-Identifier: Apache-2.0
"""Checks the tests: breaks the code on purpose, one line at a time, in a copy of the checkout, and sees who notices.

python scripts/tools/check_tests.py  # all of them; says caught or missed, by which test, and how long it took
python scripts/tools/check_tests.py tracker codec    # some
python scripts/tools/check_tests.py --list           # what would be broken
python scripts/tools/check_tests.py --nearby         # asks only the tests that should notice, not all others after them

A line of compiled code is compiled again (with ccache, where there is one). The copy is made once and thrown away.
Exits with 1 if a fault was missed.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
COPIED = ("ggslam", "tests", "scripts", "configs", "examples", "docs", "CMakeLists.txt", "pyproject.toml", "README.md",
          "mkdocs.yml", "CHANGELOG.md", "build")  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """One line that is broken.

    name: to ask for it.
    file: in the checkout.
    line: the text that is replaced; it stands in the file once.
    broken: what takes its place.
    tests: who should notice: files within tests/, or tests in them. Then their folders are asked, then all.
    """

    name: str
    file: str
    line: str
    broken: str
    tests: tuple[str, ...]

    @property
    def compiled(self) -> bool:
        """Whether the core has to be compiled again."""
        return self.file.startswith("ggslam/native/src/")


FAULTS = (
    Fault("tracker", "ggslam/tracking/motion.py", "if self.lost else inverse(self.T_world_camera) @ T_world_camera",
          "if self.lost else T_world_camera @ inverse(self.T_world_camera)", ("tracking/test_tracker.py",)),
    Fault("gicp", "ggslam/native/src/tracking/kernels/gicp.cpp", "factor = weight * ratio * ratio * s.plane_variance;",
          "factor = weight * s.plane_variance;", ("tracking/test_gicp.py",)),
    Fault("edges-planes-gpu", "ggslam/cuda/kernels/edges_planes/feature_picks.cuh",
          "rank += other > own || (other == own && k < i);", "rank += other < own || (other == own && k < i);",
          ("tracking/test_cuda_features.py",)),
    Fault("versions", "ggslam/native/src/tracking/block_lookup.hpp", "blocks[block].version > level.version",
          "blocks[block].version > ~uint32_t{1}", ("tracking/test_growing_targets.py",)),
    Fault("places", "ggslam/native/src/tracking/growing_level.cpp", "replaced_.front().version <= version;",
          "replaced_.front().version <= version + 1;", ("tracking/test_growing_targets.py",)),
    Fault("spread", "ggslam/native/src/tracking/growing_level.cpp",
          "if (spread) choose_beside(changed, version, choice);", "", ("tracking/test_growing_targets.py",)),
    Fault("delta", "ggslam/native/src/tracking/growing_level.cpp", "change.version > version && change.version <= last",
          "change.version == last", ("tracking/test_cuda_target.py",)),
    Fault("target-copy", "ggslam/tracking/cuda/target.py", "and self._staged.before == before", "",
          ("tracking/test_cuda_target.py",)),
    Fault("target-kept", "ggslam/tracking/cuda/target_memory.py", "torch._foreach_copy_(new, old)", "pass",
          ("tracking/test_cuda_target.py",)),
    Fault("still-pixels", "ggslam/native/src/tracking/still_pixels_api.cpp", "< c.job.largest_flow * slope_at",
          "< 0.9f * c.job.largest_flow * slope_at", ("tracking/test_still_pixels.py",)),
    Fault("small-grey", "ggslam/native/src/tracking/kernels/frame_images.cpp", "(sum + 2) >> 2", "sum >> 2",
          ("tracking/test_still_pixels.py",)),
    Fault("joining", "ggslam/slam/joining.py", "self._step + STEPS_BESIDE + 1", "self._step + STEPS_BESIDE",
          ("slam/test_joining.py",)),
    Fault("joining-failed", "ggslam/slam/joining.py", "under_way.give_up()", "pass", ("slam/test_joining_errors.py",)),
    Fault("rasterizer", "ggslam/native/src/rendering/kernels/tiles_backward.cpp",
          "weight = odds * t, G = odds * (t * dot - behind);", "weight = odds * t, G = odds * (t * dot + behind);",
          ("rendering/test_cpu_gradients.py",)),
    Fault("loss", "ggslam/native/src/mapping/image_loss_api.cpp", "job.total += job.dssim_weight * (1.0 - job.ssim);",
          "job.total += job.dssim_weight * (1.0 + job.ssim);", ("mapping/test_losses.py",)),
    Fault("insertion", "ggslam/native/src/mapping/kernels/insertion.cpp",
          "std::min(1 / std::clamp(dot(n, ray), 1e-3f, 1.f), job.max_slope)",
          "std::min(std::clamp(dot(n, ray), 1e-3f, 1.f), job.max_slope)", ("mapping/test_insertion.py",)),
    Fault("map", "ggslam/scene/gaussian_map.py", 'self._storage["birth_keyframe"][rows].fill_(birth_keyframe)',
          'self._storage["birth_keyframe"][rows].fill_(0)', ("scene/test_gaussian_map.py",)),
    Fault("pose-graph", "ggslam/loops/condensed.py", "corrections[node] = self.covariances[node] @ push",
          "corrections[node] = self.covariances[k] @ push", ("loops/test_pose_graph.py",)),
    Fault("codec", "ggslam/native/src/codec/kernels/quantiser.hpp", "return (q * step_[component] + 128) >> 8;",
          "return (q * step_[component]) >> 8;", ("coding/test_golden_streams.py", "coding/test_attribute_coder.py")),
    Fault("tsdf", "ggslam/native/formulas/tsdf_voxel.hpp",
          "const Float total = weight + measured, share = measured / total;",
          "const Float total = weight + measured, share = weight / total;", ("volumes/test_tsdf_fusion.py",)),
    Fault("association", "ggslam/objects/association.py",
          "within >= MatchTuning.min_within, within + covers, within - 2)",
          "within >= MatchTuning.min_within, within, within - 2)", ("objects/test_association.py",)),
    Fault("segment-planes", "ggslam/native/src/objects/points_api.cpp", "std::max(3 * median, kLeastNear)",
          "std::max(2 * median, kLeastNear)", ("objects/test_segment_points.py",)),
    Fault("segment-labels", "ggslam/native/src/objects/overlap_api.cpp", "(column < 0 ? job.columns : column)",
          "(column < 0 ? 0 : column)", ("objects/test_segment_points.py",)),
    Fault("formats", "ggslam/formats/gaussian_ply.py",
          "channel_major = sh[:, 1:].transpose(1, 2).reshape(count, 3 * rest)",
          "channel_major = sh[:, 1:].reshape(count, 3 * rest)", ("formats/test_gaussian_ply.py",)),
    Fault("levels", "ggslam/formats/splat_levels.py",
          "_covariances(ordered) + LevelTuning.spread * offsets[:, :, None] * offsets[:, None, :]",
          "_covariances(ordered)",
          ("formats/test_splat_levels.py",)),
    Fault("sequences", "ggslam/sequences/pose_files.py",
          "if values is None or _kind(values) != count:", "if values is None:", ("sequences/test_pose_files.py",)),
    Fault("scores", "ggslam/evaluation/trajectory.py", "rpe_rot_deg=float(np.rad2deg(_rms(rotation))),",
          "rpe_rot_deg=float(_rms(rotation)),", ("evaluation/test_trajectory_scores.py",)),
    Fault("records", "ggslam/runs/records/run_json.py", '"complete": self.stopped_by is None and not missing',
          '"complete": True', ("cli/test_run.py::test_truncated_png_stops_the_run_but_keeps_what_was_done",)),
    Fault("settings", "ggslam/slam/config.py", "sh_degree: int = setting(-1, -1, 3,",
          "sh_degree: int = setting(-1, -1, 5,", ("slam/test_config.py",)),
    Fault("atomic", "ggslam/system/atomic.py", "temporary.unlink(missing_ok=True)", "pass", ("system/test_atomic.py",)),
    Fault("cli", "ggslam/cli/run_command.py", "for name, value in values.items() if value is not None]",
          "for name, value in values.items() if value]",
          ("cli/test_run.py::test_other_shares_of_held_out_frames",)),
    Fault("moves-policy", "ggslam/slam/run_state.py",
          "(self.tracker, self.locator, self.filters, self.policy, self.poses)",
          "(self.tracker, self.locator, self.filters, self.poses)", ("slam/test_held_poses.py",)),
    Fault("moves-frames", "ggslam/slam/run_state.py",
          "(self.tracker, self.locator, self.filters, self.policy, self.poses)",
          "(self.tracker, self.locator, self.filters, self.policy)", ("slam/test_held_poses.py",)),
    Fault("moves-filters", "ggslam/slam/run_state.py",
          "(self.tracker, self.locator, self.filters, self.policy, self.poses)",
          "(self.tracker, self.locator, self.policy, self.poses)", ("slam/test_held_poses.py",)),
    Fault("moves-tracker", "ggslam/slam/run_state.py",
          "(self.tracker, self.locator, self.filters, self.policy, self.poses)",
          "(self.locator, self.filters, self.policy, self.poses)", ("slam/test_held_poses.py",)),
    Fault("moves-rig-clock", "ggslam/slam/run_state.py",
          "(self.tracker, self.locator, self.filters, self.policy, self.poses)",
          "(self.tracker, self.filters, self.policy, self.poses)", ("slam/test_held_poses.py",)),
    Fault("moves-counted", "ggslam/slam/run_state.py",
          "self.moves_followed += len(moves)",
          "self.moves_followed += 0", ("slam/test_held_poses.py",)),
    Fault("new-target", "ggslam/slam/run_state.py",
          "self.tracker.set_target(target)",
          "pass", ("slam/test_held_poses.py",)),
    Fault("moves-pending", "ggslam/slam/map_corrections.py",
          "return self._surface.target, self.moves[known:]",
          "return self._surface.target, self.moves", ("slam/test_held_poses.py",)),
    Fault("moves-late", "ggslam/slam/map_corrections.py",
          "T_world_camera=T_new_old @ tracking.T_world_camera)",
          "T_world_camera=tracking.T_world_camera)", ("slam/test_held_poses.py",)),
    Fault("moves-map", "ggslam/slam/map_corrections.py",
          "self._mapper.move_keyframes(correction.T_new_old)",
          "pass", ("slam/test_held_poses.py",)),
    Fault("moves-newest", "ggslam/slam/map_corrections.py",
          "self.moves.append(correction.T_new_old[-1])",
          "self.moves.append(correction.T_new_old[0])", ("slam/test_held_poses.py",)),
    Fault("moves-surface", "ggslam/slam/loop_closing.py",
          "self._surface.arrange(correction.active, correction.T_world_camera)",
          "self._surface.arrange(correction.active)", ("slam/test_held_poses.py",)),
    Fault("moves-chain", "ggslam/slam/filter_chain.py",
          "one.move(T_new_old)",
          "pass", ("slam/test_held_poses.py",)),
    Fault("moves-shutters", "ggslam/slam/filters/shutter_times.py",
          "self.T_world_depth = T_new_old @ self.T_world_depth",
          "pass", ("slam/test_held_poses.py",)),
    Fault("moves-still", "ggslam/tracking/still_camera.py",
          "self.T_world_camera = T_new_old @ self.T_world_camera",
          "pass", ("slam/test_held_poses.py",)),
    Fault("confirmations", "ggslam/slam/loop_closing.py",
          "count * s.confirmation_gap",
          "count * 1000", ("slam/test_held_poses.py",)),
    Fault("pose-share", "ggslam/mapping/mapper.py",
          "share = 1 if grid.is_whole else 1 / MapperTuning.noisy_steps",
          "share = 1", ("mapping/test_mapper.py",)),
    Fault("exposure", "ggslam/evaluation/image_sets.py",
          "- self.exposure[:, 1]",
          "+ self.exposure[:, 1]", ("evaluation/test_images.py",)),
    Fault("overlap", "ggslam/tracking/keyframes.py",
          "0.75 * s.min_overlap",
          "0.9 * s.min_overlap", ("tracking/test_keyframes.py",)),
    Fault("kill-waiting", "ggslam/system/staging.py",
          'return [path for path in found if all(record is None or record["from"] != path.name for record in waiting)]',
          "return found", ("system/test_killed_publishing.py",)),
    Fault("kill-marker", "ggslam/system/staging.py",
          'write_text(target / marker, json.dumps(record, indent=1) + "\\n", follow=False)',
          "pass", ("system/test_killed_publishing.py",)),
    Fault("kill-stale", "ggslam/system/staging.py",
          '_SAVING: {"from": staged.name, "stale": stale}',
          '_SAVING: {"from": staged.name, "stale": []}', ("system/test_killed_publishing.py",)),
)  # fmt: skip


def copy_checkout(to: Path) -> None:
    """What tests need, with what was compiled and cached."""
    for name in COPIED:
        source = CHECKOUT / name
        if source.is_dir():
            shutil.copytree(source, to / name, ignore=shutil.ignore_patterns("dev", "*.lock", "wheel"), symlinks=True)
        elif source.is_file():
            shutil.copy2(source, to / name)


def environment(copy: Path) -> dict[str, str]:
    """The copy's package comes first; recordings lie beside the true checkout."""
    shared = CHECKOUT.parent / "shared"
    given = {"GGSLAM_DATA": str(shared / "data"), "GGSLAM_GPCC": str(shared / "gpcc")}
    if shutil.which("ccache"):
        # With paths as seen from the copy, so that what one copy compiled serves the next.
        given |= {"CMAKE_CXX_COMPILER_LAUNCHER": "ccache", "CCACHE_BASEDIR": str(copy), "CCACHE_NOHASHDIR": "1"}
    return {**given, **os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": ""}


def compile_core(copy: Path) -> None:
    run = subprocess.run(
        ["bash", "scripts/build_native.sh"], cwd=copy, env=environment(copy), capture_output=True, text=True
    )
    assert run.returncode == 0, f"the broken core does not compile:\n{run.stdout}{run.stderr}"


def failed_test(copy: Path, tests: list[str]) -> str | None:
    """The first test that fails, or what pytest said where it could not run any; None: all passed."""
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-rfE", "-p", "no:cacheprovider", "--no-header", *tests]
    run = subprocess.run(words, cwd=copy, env=environment(copy), capture_output=True, text=True)
    if run.returncode == 0:
        return None
    found = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - |$)", run.stdout, re.M)
    if run.returncode == 1 and found:
        return found[1]
    if run.returncode < 0 or run.returncode > 128:  # the broken code ended the process: noticed, too
        return f"the process ended with {run.returncode}"
    raise RuntimeError(f"pytest could not run:\n{run.stdout[-3000:]}{run.stderr[-3000:]}")


def applied(fault: Fault, text: str) -> str:
    """The file's text with the fault in it.

    Raises:
        ValueError: the line is not there, or not once.
    """
    if text.count(fault.line) != 1:
        raise ValueError(f"{fault.name}: {fault.file} holds {fault.line!r} {text.count(fault.line)} times, not once")
    return text.replace(fault.line, fault.broken)


def check(fault: Fault, copy: Path, nearby: bool) -> str | None:
    """Who notices a fault; None: nobody. The copy is as before afterwards.

    Raises:
        RuntimeError: those who should notice complain without a fault, too.
    """
    complaint = failed_test(copy, [f"tests/{name}" for name in fault.tests])
    if complaint is not None:
        raise RuntimeError(f"{complaint} fails without any fault")
    path = copy / fault.file
    whole = path.read_text()
    path.write_text(applied(fault, whole))
    try:
        if fault.compiled:
            compile_core(copy)
        near = [f"tests/{name}" for name in fault.tests]
        rooms = sorted({str(Path(name.split("::")[0]).parent) for name in near})
        for tests in [near] if nearby else [near, rooms, ["tests"]]:
            noticed = failed_test(copy, tests)
            if noticed is not None:
                return noticed
        return None
    finally:
        path.write_text(whole)
        if fault.compiled:  # the compiled core of the true checkout
            shutil.copytree(CHECKOUT / "ggslam/native/_lib", copy / "ggslam/native/_lib", dirs_exist_ok=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="faults to check; default: all")
    parser.add_argument("--list", action="store_true", help="say what would be broken")
    parser.add_argument("--nearby", action="store_true", help="ask only the tests that should notice")
    arguments = parser.parse_args()
    unknown = set(arguments.names) - {fault.name for fault in FAULTS}
    if unknown:
        parser.error(f"no faults of these names: {', '.join(sorted(unknown))}")
    chosen = [fault for fault in FAULTS if not arguments.names or fault.name in arguments.names]
    if arguments.list:
        for fault in chosen:
            print(f"{fault.name}: {fault.file}\n  - {fault.line}\n  + {fault.broken}")
        return 0
    missed = 0
    with tempfile.TemporaryDirectory(prefix="ggslam-faults-") as folder:
        copy = Path(folder) / "ggslam"
        copy.mkdir()
        copy_checkout(copy)
        for fault in chosen:
            start = time.monotonic()
            try:
                noticed = check(fault, copy, arguments.nearby)
                said = "MISSED" if noticed is None else "caught"
            except RuntimeError as error:
                noticed, said = str(error), "FAILED"
            missed += said != "caught"
            print(f"{said}  {fault.name:12} {time.monotonic() - start:5.0f} s  {noticed or ''}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} faults caught")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
