# SPDX-License-Identifier: Apache-2.0
"""verdict.json: figures that measure what they say, grades that tell sound runs from faulty ones."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ggslam

from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.report.pages import write_report
from ggslam.jobs.run.evaluate_run import evaluate_run
from ggslam.jobs.run.grades import (
    MapGradeTuning,
    ScoredFigures,
    grade_geometry,
    grade_movers,
    grade_objects,
    grade_sharp,
    grade_tracked,
    jumps_of,
    path_jumps,
)
from ggslam.jobs.run.map_fit import MapFit, measure_fit
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute
from ggslam.jobs.run.run_verdict import judge_result, judge_scores, overall
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.movers.mover_table import FoundMover, MoverSight
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.verdict import AspectRecord, RunVerdict
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import SH_C0, GaussianMap
from ggslam.sequences import open_sequence
from ggslam.sequences.verdicts import Verdict
from ggslam.slam.result import SlamResult, TrackedFrame

QUICK = ["mapping.iterations_per_frame=2", "loops.enabled=false"]
FAST = [word for setting in QUICK for word in ("--set", setting)]


@pytest.fixture(scope="module")
def sound(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunOutcome:
    """A run of the whole room."""
    out = tmp_path_factory.mktemp("sound") / "run"
    return execute(RunRequest(SequenceRequest(room), out=out, overrides=QUICK))


def fit_of(outcome: RunOutcome, keyframes: list[Keyframe] | None = None) -> MapFit:
    chosen = outcome.result.keyframes if keyframes is None else keyframes
    fit = measure_fit(chosen, RunFolder.open(outcome.folder.path).map_in_parts().in_view)
    assert fit is not None
    return fit


def test_a_sound_run_is_good(sound: RunOutcome) -> None:
    verdict = sound.verdict
    assert verdict is not None and verdict.grade == "good" and not verdict.next and not verdict.failure
    assert [aspect.grade for aspect in verdict.aspects().values()] == ["good"] * 5
    fit = fit_of(sound)
    assert fit.agreeing > 0.99 and fit.structure > 0.96 and fit.brightness == pytest.approx(1, abs=0.02)
    assert verdict.geometry.value == pytest.approx(100 * fit.agreeing) and verdict.sharp.value == fit.psnr
    assert verdict.tracked.value == 100 and verdict.objects.value == len(sound.folder.object_table())


def test_it_is_kept_and_begins_the_report(sound: RunOutcome, tmp_path: Path) -> None:
    folder = RunFolder.open(sound.folder.path)
    assert folder.verdict() == sound.verdict
    assert RunVerdict.FILE in (folder.mark().files or {}) and folder.mark().complete
    copy = RunFolder(Path(shutil.copytree(folder.path, tmp_path / "run")))
    assert sound.verdict is not None
    changed = sound.verdict.model_copy(update={"grade": "bad", "next": "`depth_scale` 5000"})
    with copy.change_files(RunVerdict.FILE):
        changed.write(copy.path)
    page = write_report(copy).read_text()
    place = page.index("Verdict: <b>bad</b>")
    assert place < page.index('class="tiles"') and "To try: `depth_scale` 5000" in page[place:]


def test_scoring_grades_anew_what_scores_decide(sound: RunOutcome, tmp_path: Path) -> None:
    """The same scores give the same verdict; others another; and back. The rest stays as the run measured it."""
    folder = RunFolder(Path(shutil.copytree(sound.folder.path, tmp_path / "run")))
    before, metrics, table = folder.verdict(), folder.metrics(), folder.object_table()
    assert before is not None and metrics is not None and before.fit is not None
    assert MapFit(**vars(before.fit)) == fit_of(sound)
    evaluate_run(folder, lpips=False)
    after = folder.verdict()
    assert after == before and folder.mark().files is not None
    images = metrics.images.model_copy(update={
        "keyframes": metrics.images.keyframes.model_copy(update={"psnr_affine": 45.0}),
        "held_out": metrics.images.held_out.model_copy(update={"psnr_affine": 20.0}),
    })  # fmt: skip
    overfit = judge_scores(before, table, metrics.model_copy(update={"images": images}))
    assert (overfit.grade, overfit.sharp.grade, overfit.next) == ("doubtful", "doubtful", "`refine` 3000")
    assert "held-out frames are 25.0 dB worse" in overfit.sharp.text and overfit.tracked == before.tracked
    unlike = metrics.model_copy(update={"segmentation": None})
    assert "as the masks are" not in judge_scores(before, table, unlike).objects.text
    assert judge_scores(overfit, table, metrics) == before


def test_an_edited_run_has_no_verdict_of_another_map(sound: RunOutcome, tmp_path: Path) -> None:
    folder = sound.folder.path
    number = sound.folder.object_table().objects[0].id
    assert ggslam("edit", folder, "--rename", f"{number}", "thing", "--out", tmp_path / "named").returncode == 0
    assert RunFolder.open(tmp_path / "named").verdict() == sound.verdict
    copy = Path(shutil.copytree(folder, tmp_path / "in_place"))
    for target in (["--in-place"], ["--out", tmp_path / "other"]):
        source = copy if len(target) == 1 else folder
        assert ggslam("edit", source, "--remove", number, *target).returncode == 0
        edited = RunFolder.open(copy if len(target) == 1 else tmp_path / "other")
        assert edited.verdict() is None and "Verdict:" not in write_report(edited).read_text()
        evaluate_run(edited, lpips=False, every=4)
        assert edited.verdict() is None


def test_depth_that_is_elsewhere_is_measured(sound: RunOutcome) -> None:
    """Of a part of the rows the depth is 10 % larger: that part does not agree."""
    moved = []
    for keyframe in sound.result.keyframes:
        depth = keyframe.depth.copy()
        depth[:36] = np.rint(1.1 * depth[:36]).astype(np.uint16)
        moved.append(replace(keyframe, depth=depth))
    share = np.mean([(k.depth[:36] > 0).sum() / (k.depth > 0).sum() for k in sound.result.keyframes])
    fit = fit_of(sound, moved)
    assert fit.agreeing == pytest.approx(1 - share, abs=0.03) and fit.agreeing < MapGradeTuning.bad_depth_agreement
    assert grade_geometry(fit, []).grade == "bad"


def test_images_that_are_elsewhere_are_measured(sound: RunOutcome) -> None:
    moved = [replace(k, color=np.roll(k.color, 4, 1)) for k in sound.result.keyframes]
    fit = fit_of(sound, moved)
    assert fit.structure < MapGradeTuning.bad_structure and fit.psnr < fit_of(sound).psnr - 8
    assert grade_sharp(fit, ScoredFigures()).grade == "bad"


def test_a_dark_map_is_not_sharp_however_well_it_fits(sound: RunOutcome) -> None:
    """A fifth as bright, which the keyframes' exposure makes up for: only the brightness differs."""
    gain, parts = 0.2, RunFolder.open(sound.folder.path).map_in_parts()

    def dark(camera: Camera, T_camera_world: np.ndarray) -> GaussianMap:
        gaussians = parts.in_view(camera, T_camera_world).copy("cpu")
        gaussians.sh[:] *= gain
        gaussians.sh[:, 0] += (gain - 1) * 0.5 / SH_C0
        return gaussians

    exposed = [replace(k, exposure=np.tile([1 / gain, 0.0], (3, 1))) for k in sound.result.keyframes]
    well, fit = fit_of(sound), measure_fit(exposed, dark)
    assert fit is not None and fit.brightness == pytest.approx(gain * well.brightness, rel=0.01)
    assert fit.psnr == pytest.approx(well.psnr, abs=0.5)  # in their own exposure
    assert grade_sharp(well, ScoredFigures()).grade == "good" and grade_sharp(fit, ScoredFigures()).grade == "bad"


def test_noise_does_not_make_it_bad(sound: RunOutcome) -> None:
    random = np.random.default_rng(0)
    large = []
    for k in sound.result.keyframes:
        noise = random.normal(0, 12, k.color.shape)
        large.append(replace(k, color=np.clip(k.color + noise, 0, 255).astype(np.uint8)))
    noisy = fit_of(sound, large)
    assert noisy.psnr < fit_of(sound).psnr - 4 and grade_sharp(noisy, ScoredFigures()).grade != "bad"


def test_nothing_to_compare_with(sound: RunOutcome) -> None:
    elsewhere = [replace(k, frame_index=FROM_EARLIER_RUN) for k in sound.result.keyframes]
    view = RunFolder.open(sound.folder.path).map_in_parts().in_view
    assert measure_fit(elsewhere, view) is None
    assert measure_fit([replace(k, depth=np.zeros_like(k.depth)) for k in sound.result.keyframes], view) is None
    assert grade_sharp(None, ScoredFigures()).grade is None and grade_geometry(None, []).grade is None


def with_states(result: SlamResult, **counts: int) -> SlamResult:
    """The result with so many of the last frames in these states."""
    states = [name for name, count in counts.items() for _ in range(count)]
    kept = len(result.frames) - len(states)
    frames = result.frames[:kept] + [replace(f, status=s) for f, s in zip(result.frames[kept:], states, strict=True)]
    return replace(result, frames=frames)


@pytest.mark.parametrize(
    ("counts", "grade"),
    [({}, "good"), ({"lost": 1}, "good"), ({"lost": 3}, "doubtful"), ({"lost": 5, "doubted": 4}, "bad"),
     ({"recovered": 11}, "good"), ({"recovered": 13}, "doubtful")],
)  # fmt: skip
def test_states_of_frames(sound: RunOutcome, counts: dict[str, int], grade: str) -> None:
    assert grade_tracked(with_states(sound.result, **counts), []).grade == grade


def moved_from(frames: list[TrackedFrame], first: int, metres: float) -> Iterator[TrackedFrame]:
    for frame in frames:
        T = frame.T_keyframe_camera.copy()
        T[:3, 3] += [metres if frame.frame_index >= first else 0, 0, 0]
        yield replace(frame, T_keyframe_camera=T)


@pytest.mark.parametrize("name", ["hololens_walk", "redkitchen", "livingroom", "phone_scan"])
def test_true_paths_do_not_jump(shared_data: Path, name: str) -> None:
    """Nor where somebody turns the head at once; a step of half a metre in the middle of them is one."""
    if not (shared_data / name).is_dir():
        pytest.skip(f"no recording at {shared_data / name}")
    truth = open_sequence(shared_data / name).ground_truth
    assert truth is not None
    places, index = truth[:, :3, 3].copy(), np.arange(len(truth))
    assert jumps_of(places, index) == []
    middle = len(places) // 2
    places[middle:, 0] += 0.5
    assert middle in jumps_of(places, index) and len(jumps_of(places, index)) == 2


def test_a_jump_of_the_path_is_found_where_it_is(sound: RunOutcome) -> None:
    assert path_jumps(sound.result) == []
    jumped = replace(sound.result, frames=list(moved_from(sound.result.frames, 12, 0.5)))
    assert path_jumps(jumped) == [12, 13]  # the way to it, and on from it
    aspect = grade_tracked(jumped, [])
    assert aspect.grade == "doubtful" and "the first: frame 12" in aspect.text


def mover(number: int, frames: range, share: float) -> FoundMover:
    low, high = -np.ones(3), np.ones(3)
    return FoundMover(number, None, "rigid", frames[0], [MoverSight(f, np.eye(4), low, high, share) for f in frames])


@pytest.mark.parametrize(
    ("movers", "grade", "share"),
    [([], "good", 0), ([mover(1, range(24), 0.25)], "good", 100), ([mover(1, range(24), 0.6)], "bad", 100),
     ([mover(n, range(n, n + 12), 0.01) for n in range(7)], "doubtful", 75),
     ([mover(n, range(n, n + 2), 0.01) for n in range(20)], "bad", 87.5)],
    ids=["none", "a person", "the whole picture", "several a frame", "noise"],
)  # fmt: skip
def test_movers(sound: RunOutcome, movers: list[FoundMover], grade: str, share: float) -> None:
    aspect = grade_movers(replace(sound.result, movers=movers))
    assert aspect.grade == grade and aspect.value == pytest.approx(share)


def test_objects(sound: RunOutcome) -> None:
    table = sound.folder.object_table()
    assert grade_objects(table, ScoredFigures()).grade == "good"
    assert grade_objects(table, ScoredFigures(id_accuracy=0.3)).grade == "bad"
    counts = [10 * sum(o.gaussians for o in table.objects), 1]
    one = replace(table, objects=[replace(o, gaussians=n) for o, n in zip(table.objects, counts, strict=False)])
    assert grade_objects(one, ScoredFigures()).grade == "bad"
    assert grade_objects(replace(table, objects=[]), ScoredFigures()).grade == "bad"
    assert grade_objects(None, ScoredFigures()).grade is None


def test_objects_count_less_than_what_they_stand_on() -> None:
    well = {name: AspectRecord(grade="good") for name in ("tracked", "sharp", "geometry", "objects", "movers")}
    assert overall(well) == "good"
    assert overall({**well, "objects": AspectRecord(grade="doubtful")}) == "good"
    assert overall({**well, "objects": AspectRecord(grade="bad")}) == "doubtful"
    assert overall({**well, "geometry": AspectRecord(grade="bad")}) == "bad"
    assert overall({**well, "sharp": AspectRecord()}) == "good"  # not measured


def test_what_to_try_is_the_cause_if_it_is_known(sound: RunOutcome) -> None:
    lost = with_states(sound.result, lost=20)
    named = Verdict("depth_scale", "wrong", "depth scale 1000 is suspicious: far; try `depth_scale` 5000, then 1 m")
    verdict = judge_result(lost, [named], fit_of(sound), None, None, "room")
    assert verdict.grade == "bad" and verdict.next == "`depth_scale` 5000, then 1 m"
    assert verdict.failure.startswith("the camera was lost in 20 of 24 frames (the first: 4)")
    assert verdict.sharp.grade is None  # of the few others it would be good
    noisy = replace(fit_of(sound), structure=0.94)
    empty = replace(sound.folder.object_table(), objects=[])
    assert judge_result(sound.result, [], noisy, empty, None, "room").next == "`refine` 3000"
    assert judge_result(sound.result, [], fit_of(sound), empty, None, "room").next.startswith("`masks` FOLDER")
    code = Verdict("depth_codes", "doubtful", "it seems to mean that nothing was measured; try `depth_kind` none:40000")
    holes = replace(fit_of(sound), agreeing=0.8)
    assert judge_result(sound.result, [code], holes, None, None, "room").next == "`depth_kind` none:40000"
    unnamed = judge_result(lost, [], None, None, None, "room")
    assert unnamed.next.startswith("ggslam inspect room")


def test_a_headline_counts_in_english(sound: RunOutcome) -> None:
    one = replace(sound.result, frames=sound.result.frames[:1], keyframes=sound.result.keyframes[:1])
    words = replace(sound, result=one).headline().split(", ")
    assert words[0] == "1 frame" and "1 keyframe" in words


@dataclass
class Copy:
    """A copy of the room, to be spoilt."""

    path: Path

    def paths(self, kind: str) -> list[Path]:
        return sorted((self.path / kind).iterdir())


@pytest.fixture
def spoilt(room: Path, tmp_path: Path) -> Copy:
    return Copy(Path(shutil.copytree(room, tmp_path / "spoilt")))


def test_most_frames_lost_is_a_failure_that_shows_no_scores(spoilt: Copy, tmp_path: Path) -> None:
    """From frame 2 on the camera looks at a wall elsewhere."""
    random = np.random.default_rng(0)
    for color, depth in zip(spoilt.paths("rgb")[2:], spoilt.paths("depth")[2:], strict=True):
        shape = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED).shape
        cv2.imwrite(str(color), random.integers(0, 255, (*shape, 3), np.uint8))
        cv2.imwrite(str(depth), random.integers(300, 60000, shape, np.uint16))
    done = ggslam("run", spoilt.path, "--stop", "10", "--out", tmp_path / "run", *FAST)
    assert done.returncode == 1
    assert "error: the camera was lost in 8 of 10 frames (the first: 2)" in " ".join(done.stderr.split())
    assert "verdict: bad" in done.stdout and "PSNR" not in done.stdout.partition("frames lost")[2]
    verdict = RunFolder.open(tmp_path / "run").verdict()
    assert verdict is not None and verdict.tracked.grade == "bad" and verdict.tracked.value == 20


def test_a_run_that_stopped_early_or_saw_hardly_anything_is_not_called_good(sound: RunOutcome) -> None:
    stopped = judge_result(sound.result, [], fit_of(sound), None, None, "room", stopped=True)
    assert stopped.grade == "doubtful" and "stopped before the end" in stopped.tracked.text
    assert "skip_bad_frames" in stopped.next
    assert grade_tracked(replace(sound.result, frames=sound.result.frames[:2]), []).grade == "doubtful"
    assert grade_tracked(replace(sound.result, frames=sound.result.frames[:3]), []).grade == "good"


def test_a_map_that_fits_badly_asks_for_the_principal_point_of_a_crop(sound: RunOutcome) -> None:
    """A run of sound images with the same numbers is not doubted: lenses may look aside."""
    first, *others = sound.result.keyframes
    aside = replace(first.camera, cx=first.camera.cx + 0.12 * first.camera.width)
    result = replace(sound.result, keyframes=[replace(first, camera=aside), *others])
    blurred = replace(fit_of(sound), structure=0.94)
    advice = judge_result(result, [], blurred, None, None, "room").next
    assert advice.startswith(f"check cx {aside.cx:.1f} and cy") and "crop" in advice
    assert judge_result(result, [], fit_of(sound), None, None, "room").next == ""


class StopsInRefinement(SilentObserver):
    """Asks the run to stop after the first step of the refinement."""

    def advance(self, done: int, total: int) -> None:
        raise KeyboardInterrupt


def test_a_run_whose_refinement_was_cut_short_saw_all_frames(room: Path, tmp_path: Path) -> None:
    few = ["mapping.iterations_per_frame=2", "loops.enabled=false", "refine_iterations=500"]
    request = RunRequest(SequenceRequest(room, stop=6), out=tmp_path / "run", overrides=few)
    outcome = execute(request, StopsInRefinement())
    assert isinstance(outcome.error, KeyboardInterrupt) and outcome.verdict is not None
    assert outcome.verdict.tracked.text == "6 of 6 frames located" and outcome.verdict.tracked.grade == "good"
    assert "the refinement was cut short" in outcome.verdict.sharp.text and outcome.verdict.grade != "good"


def test_a_dark_beginning_does_not_spoil_a_run(spoilt: Copy, tmp_path: Path) -> None:
    for path, gain in zip(spoilt.paths("rgb"), (0.12, 0.15), strict=False):
        image = cv2.imread(str(path)).astype(np.float32)
        cv2.imwrite(str(path), np.rint(gain * image).astype(np.uint8))
    done = ggslam("run", spoilt.path, "--out", tmp_path / "dark", *FAST)
    assert done.returncode == 0 and "verdict: good" in done.stdout
    assert "frame 0 0.12 times as bright" in done.stdout


def test_runs_without_scores_have_one(room: Path, tmp_path: Path) -> None:
    outcome = execute(
        RunRequest(SequenceRequest(room, stop=6), out=tmp_path / "run", overrides=QUICK, evaluate=False)
    )
    verdict = RunFolder.open(tmp_path / "run").verdict()
    assert outcome.metrics is None and verdict is not None and verdict.sharp.grade == "good"
    assert verdict == outcome.verdict


def test_rigs_have_one(rig: Path, tmp_path: Path) -> None:
    outcome = execute(RunRequest(SequenceRequest(rig, stop=6), out=tmp_path / "run", overrides=QUICK, evaluate=False))
    assert outcome.verdict is not None and outcome.verdict.tracked.grade == "good"
    assert outcome.verdict.geometry.grade == "good" and path_jumps(outcome.result) == []


def test_real_time_runs_have_one(room: Path, tmp_path: Path) -> None:
    more = [*QUICK, "realtime_fps=20"]
    outcome = execute(RunRequest(SequenceRequest(room), out=tmp_path / "run", overrides=more, evaluate=False))
    assert outcome.verdict is not None and outcome.verdict.tracked.grade is not None
    assert outcome.verdict.geometry.grade is not None


def test_frames_located_in_a_map_of_other_colours(room_run: RunFolder, spoilt: Copy, tmp_path: Path) -> None:
    """The map fits the frames it was made of; with their channels exchanged their depth alone."""

    def located(name: str) -> RunVerdict:
        asked = SequenceRequest(spoilt.path, stop=10)
        verdict = execute(RunRequest(asked, tmp_path / name, map=room_run.path, localize_only=True)).verdict
        assert verdict is not None
        return verdict

    here = located("here")
    for path in spoilt.paths("rgb"):
        cv2.imwrite(str(path), cv2.imread(str(path))[:, :, [1, 2, 0]])
    other = located("other")
    assert here.grade == "good" and here.fit is not None and here.fit.located and here.fit.structure > 0.95
    assert (other.sharp.grade, other.geometry.grade) == ("bad", "good")
    assert "the map looks otherwise" in other.sharp.text and "update" in other.next


def test_what_is_said_of_a_recording_counts(sound: RunOutcome) -> None:
    def graded(*codes: str) -> RunVerdict:
        found = [Verdict(code, "doubtful", "told; try it") for code in codes]
        return judge_result(sound.result, found, fit_of(sound), None, None, "room")

    assert graded().grade == "good"
    for code, aspect, grade in (
        ("color_noise", "sharp", "bad"), ("unrelated", "sharp", "bad"), ("color_repeats", "sharp", "doubtful"),
        ("depth_repeats", "geometry", "doubtful"), ("intrinsics", "geometry", "doubtful"),
        ("no_motion", "tracked", "doubtful"), ("depth_noise", "tracked", "bad"),
    ):  # fmt: skip
        verdict = graded(code)
        assert (verdict.grade, verdict.aspects()[aspect].grade, verdict.next) == (grade, grade, "it"), code
