# SPDX-License-Identifier: Apache-2.0
"""ggslam: RGB-D Gaussian SLAM that runs on two CPU cores.

What `dir(ggslam)` lists is the public face: documented in docs/python.md and docs/pytorch.md, kept from version to
version. Everything else, all modules below this one, is private and may change at any time. Names are loaded when they
are first used: `import ggslam` alone takes milliseconds and loads no torch.
"""

from __future__ import annotations

import difflib as _difflib
import importlib as _importlib
import os as _os
from typing import TYPE_CHECKING as _TYPE_CHECKING

from ggslam.system.forks import rest_before_forks as _rest_before_forks

if _TYPE_CHECKING:
    from ggslam.coding import CodecSettings as CodecSettings
    from ggslam.coding import decode_cloud as decode_cloud
    from ggslam.coding import encode_cloud as encode_cloud
    from ggslam.errors import ConfigError as ConfigError
    from ggslam.errors import FormatError as FormatError
    from ggslam.errors import GgslamError as GgslamError
    from ggslam.errors import InputError as InputError
    from ggslam.errors import MissingDependency as MissingDependency
    from ggslam.errors import RenderError as RenderError
    from ggslam.errors import RunFolderError as RunFolderError
    from ggslam.errors import SequenceError as SequenceError
    from ggslam.evaluation.geometry import score_cloud as score_cloud
    from ggslam.evaluation.images import score_image as score_image
    from ggslam.evaluation.segmentation import SegmentationCounts as SegmentationCounts
    from ggslam.evaluation.trajectory import score_trajectory as score_trajectory
    from ggslam.formats.gaussian_ply import read_gaussian_ply as read_gaussian_ply
    from ggslam.formats.gaussian_ply import write_gaussian_ply as write_gaussian_ply
    from ggslam.formats.point_cloud import read_point_cloud as read_point_cloud
    from ggslam.formats.point_cloud import write_point_cloud as write_point_cloud
    from ggslam.formats.point_sampling import sample_points as sample_points
    from ggslam.formats.splat_formats import read_splats as read_splats
    from ggslam.formats.trajectory import Trajectory as Trajectory
    from ggslam.formats.trajectory import read_trajectory as read_trajectory
    from ggslam.formats.trajectory import write_tum as write_tum
    from ggslam.jobs.changes.changes import find_changes as find_changes
    from ggslam.jobs.compare.comparison import compare_maps as compare_maps
    from ggslam.jobs.edit.edit import Edit as Edit
    from ggslam.jobs.edit.edits import edit_run as edit_run
    from ggslam.jobs.export.export_run import export_run as export_run
    from ggslam.jobs.localize.localize_recording import localize_recording as localize_recording
    from ggslam.jobs.merge.merge import merge_runs as merge_runs
    from ggslam.jobs.plan.plan_path import plan_path as plan_path
    from ggslam.jobs.refine.refine_run import refine_run as refine_run
    from ggslam.jobs.render.film import render_film as render_film
    from ggslam.jobs.render.plan import render_plan as render_plan
    from ggslam.jobs.render.render_run import render_run as render_run
    from ggslam.jobs.run.evaluate_run import evaluate_run as evaluate_run
    from ggslam.jobs.run.pipeline import RunOutcome as RunOutcome
    from ggslam.jobs.run.run_recording import run_recording as run_recording
    from ggslam.jobs.update.update import update_run as update_run
    from ggslam.jobs.volumes.fuse_volumes import fuse_volumes as fuse_volumes
    from ggslam.objects.lookup import objects_at as objects_at
    from ggslam.objects.table import ObjectTable as ObjectTable
    from ggslam.rendering import GaussianModel as GaussianModel
    from ggslam.rendering import RenderBuffers as RenderBuffers
    from ggslam.rendering import color_loss as color_loss
    from ggslam.rendering import depth_loss as depth_loss
    from ggslam.rendering import identity_loss as identity_loss
    from ggslam.rendering import neighbour_loss as neighbour_loss
    from ggslam.rendering import render as render
    from ggslam.runs.folder import RunFolder as RunFolder
    from ggslam.runs.opened_points import surface_points as surface_points
    from ggslam.runs.saving import save_run as save_run
    from ggslam.scene.camera import Camera as Camera
    from ggslam.scene.camera_models import DistortedCamera as DistortedCamera
    from ggslam.scene.camera_models import OrthographicCamera as OrthographicCamera
    from ggslam.scene.frame import Frame as Frame
    from ggslam.scene.gaussian_map import GaussianMap as GaussianMap
    from ggslam.sequences import Sequence as Sequence
    from ggslam.sequences import collate_frames as collate_frames
    from ggslam.sequences import open_sequence as open_sequence
    from ggslam.sequences.live import LiveSequence as LiveSequence
    from ggslam.slam.config import Config as Config
    from ggslam.slam.config import load_config as load_config
    from ggslam.slam.result import SlamResult as SlamResult
    from ggslam.slam.result import StepReport as StepReport
    from ggslam.slam.slam import Slam as Slam
    from ggslam.synthetic import write_synthetic_sequence as write_synthetic_sequence
    from ggslam.volumes.esdf import DistanceField as DistanceField
    from ggslam.volumes.occupancy import OccupancyMap as OccupancyMap
    from ggslam.volumes.tsdf import TsdfMap as TsdfMap

# With one other busy process, OpenMP's spinning barriers make torch's own operators many times slower; this must be
# set before torch is imported for the first time.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# And after every matrix product the threads of numpy's and scipy's OpenBLAS spin for milliseconds, on a core that the
# compiled core needs: learning objects took twice as much processor time (2^4 cycles instead of 2^26).
_os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")

__version__ = "0.1.0"

_HOMES = {
    "ggslam.coding": ("CodecSettings", "decode_cloud", "encode_cloud"),
    "ggslam.errors": (
        "ConfigError",
        "FormatError",
        "GgslamError",
        "InputError",
        "MissingDependency",
        "RenderError",
        "RunFolderError",
        "SequenceError",
    ),
    "ggslam.evaluation.geometry": ("score_cloud",),
    "ggslam.evaluation.images": ("score_image",),
    "ggslam.evaluation.segmentation": ("SegmentationCounts",),
    "ggslam.evaluation.trajectory": ("score_trajectory",),
    "ggslam.formats.gaussian_ply": ("read_gaussian_ply", "write_gaussian_ply"),
    "ggslam.formats.point_cloud": ("read_point_cloud", "write_point_cloud"),
    "ggslam.formats.point_sampling": ("sample_points",),
    "ggslam.runs.opened_points": ("surface_points",),
    "ggslam.formats.splat_formats": ("read_splats",),
    "ggslam.formats.trajectory": ("Trajectory", "read_trajectory", "write_tum"),
    "ggslam.jobs.edit.edit": ("Edit",),
    "ggslam.jobs.edit.edits": ("edit_run",),
    "ggslam.jobs.export.export_run": ("export_run",),
    "ggslam.jobs.changes.changes": ("find_changes",),
    "ggslam.jobs.compare.comparison": ("compare_maps",),
    "ggslam.jobs.plan.plan_path": ("plan_path",),
    "ggslam.jobs.localize.localize_recording": ("localize_recording",),
    "ggslam.jobs.merge.merge": ("merge_runs",),
    "ggslam.jobs.refine.refine_run": ("refine_run",),
    "ggslam.jobs.update.update": ("update_run",),
    "ggslam.jobs.volumes.fuse_volumes": ("fuse_volumes",),
    "ggslam.jobs.render.film": ("render_film",),
    "ggslam.jobs.render.plan": ("render_plan",),
    "ggslam.jobs.render.render_run": ("render_run",),
    "ggslam.jobs.run.pipeline": ("RunOutcome",),
    "ggslam.jobs.run.run_recording": ("run_recording",),
    "ggslam.jobs.run.evaluate_run": ("evaluate_run",),
    "ggslam.objects.lookup": ("objects_at",),
    "ggslam.objects.table": ("ObjectTable",),
    "ggslam.rendering": (
        "GaussianModel",
        "RenderBuffers",
        "color_loss",
        "depth_loss",
        "identity_loss",
        "neighbour_loss",
        "render",
    ),
    "ggslam.runs.folder": ("RunFolder",),
    "ggslam.runs.saving": ("save_run",),
    "ggslam.scene.camera": ("Camera",),
    "ggslam.scene.camera_models": ("DistortedCamera", "OrthographicCamera"),
    "ggslam.scene.frame": ("Frame",),
    "ggslam.scene.gaussian_map": ("GaussianMap",),
    "ggslam.sequences": ("Sequence", "collate_frames", "open_sequence"),
    "ggslam.sequences.live": ("LiveSequence",),
    "ggslam.slam.config": ("Config", "load_config"),
    "ggslam.slam.result": ("SlamResult", "StepReport"),
    "ggslam.slam.slam": ("Slam",),
    "ggslam.synthetic": ("write_synthetic_sequence",),
    "ggslam.volumes.esdf": ("DistanceField",),
    "ggslam.volumes.occupancy": ("OccupancyMap",),
    "ggslam.volumes.tsdf": ("TsdfMap",),
}
"""Where each public name is at home."""
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(["__version__", *_HOME_OF])


_rest_before_forks()


def __getattr__(name: str) -> object:
    """Loads a public name when it is first used (PEP 562)."""
    if name not in _HOME_OF:
        near = _difflib.get_close_matches(name, _HOME_OF, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise AttributeError(f"module 'ggslam' has no attribute {name!r}{hint}")
    value: object = getattr(_importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
