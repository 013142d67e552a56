# SPDX-License-Identifier: Apache-2.0
"""Prints scores."""

from __future__ import annotations

from typing import Any

from ggslam.cli.console import console, table

_IMAGE_COLUMNS = [
    ("frames", "frames", 1.0, "d"), ("PSNR", "psnr", 1.0, ".2f"), ("PSNR unmasked", "psnr_unmasked", 1.0, ".2f"),
    ("SSIM", "ssim", 1.0, ".3f"), ("LPIPS", "lpips", 1.0, ".3f"), ("depth L1 cm", "depth_l1_m", 100.0, ".2f"),
]  # fmt: skip


_SEGMENTATION_COLUMNS = [
    ("objects", "objects", 1.0, "d"), ("mIoU", "miou", 100.0, ".1f"), ("boundary", "boundary_miou", 100.0, ".1f"),
    ("accuracy", "accuracy", 100.0, ".1f"), ("precision", "precision", 100.0, ".0f"),
    ("recall", "recall", 100.0, ".0f"), ("votes", "votes_miou", 100.0, ".1f"),
]  # fmt: skip
_LOWEST = 5


def _text(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else format(value if form == "d" else factor * value, form)


def print_scores(metrics: dict[str, Any]) -> None:
    """A table of the image scores, one of the objects, and a line each for trajectory and speed."""
    rows = [
        [name.replace("_", " "), *(_text(scores.get(key), factor, form) for _, key, factor, form in _IMAGE_COLUMNS)]
        for name, scores in metrics["images"].items()
    ]
    columns = ["scores", *(title for title, *_ in _IMAGE_COLUMNS)]
    console.print(table("images; all but 'unmasked' over pixels with measured depth", columns, rows))
    if metrics.get("segmentation"):
        _print_segmentation(metrics["segmentation"])
    console.print(_trajectory_line(metrics.get("trajectory")), highlight=False)
    console.print(_speed_line(metrics), highlight=False)
    for note in metrics.get("notes", []):
        console.print(f"note: {note}", highlight=False, markup=False)


def _print_segmentation(s: dict[str, Any]) -> None:
    rows = [
        [name.replace("_", " "), *(_text(s[name][key], factor, form) for _, key, factor, form in _SEGMENTATION_COLUMNS)]
        for name in ("keyframes", "held_out", "all")
    ]
    matched = "equal ids" if s["matching"] == "same" else "ids matched one to one"
    columns = ["scores", *(title for title, *_ in _SEGMENTATION_COLUMNS)]
    console.print(table(f"objects against masks, %; {matched}", columns, rows))
    lowest = sorted(s["per_object"].items(), key=lambda item: item[1]["iou"])[:_LOWEST]
    labels = [f"{o['name']} ({i})" if o["name"] else f"object {i}" for i, o in lowest]
    texts = [f"{label} {_text(o['iou'], 100, '.1f')} %" for label, (_, o) in zip(labels, lowest, strict=True)]
    console.print(f"lowest IoU: {', '.join(texts)}", highlight=False, markup=False)
    g = s["gaussians"]
    right, by_opacity = (_text(g[key], 100, ".1f") for key in ("accuracy", "accuracy_by_opacity"))
    console.print(
        f"Gaussians: {right} % ({by_opacity} % by opacity) labelled right of {g['labelled']} with a true label",
        highlight=False,
    )


def _trajectory_line(t: dict[str, Any] | None) -> str:
    if not t:
        return "trajectory: no ground truth to compare with"
    centimetres = {key: _text(t[key], 100, ".2f") for key in t if key.endswith("_m")}
    return (
        f"trajectory: ATE RMSE {centimetres['ate_rmse_m']} cm, mean {centimetres['ate_mean_m']} cm (aligned), "
        f"raw {centimetres['ate_raw_rmse_m']} cm; RPE {centimetres['rpe_trans_m']} cm, "
        f"{_text(t['rpe_rot_deg'], 1, '.3f')} deg"
    )


def _speed_line(metrics: dict[str, Any]) -> str:
    s = metrics["speed"]
    return (
        f"speed: {_text(s['frames_per_s'], 1, '.1f')} frames/s, tracking {_text(s['tracking_ms'], 1, '.1f')} ms a "
        f"frame, mapping {_text(s['mapping_iteration_ms'], 1, '.1f')} ms an iteration; {metrics['map']['gaussians']} "
        f"Gaussians, peak memory {_text(metrics['memory']['peak_rss_mb'], 1, '.0f')} MB"
    )
