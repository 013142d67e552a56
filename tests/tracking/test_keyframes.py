# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.scene.poses import se3_exp
from ggslam.tracking.keyframes import KeyframeKind, KeyframePolicy, KeyframeSettings


@dataclass(frozen=True)
class Tracked:
    overlap: float = 1.0
    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    median_depth_m: float = 2.0


def started(settings: KeyframeSettings | None = None) -> KeyframePolicy:
    policy = KeyframePolicy(settings)
    assert policy.decide(0, Tracked(overlap=0.0))
    assert policy.kind is KeyframeKind.FIRST
    return policy


def test_a_still_camera_gives_a_mapping_keyframe_every_few_frames() -> None:
    policy = started(KeyframeSettings(max_gap=5))
    chosen = [i for i in range(1, 16) if policy.decide(i, Tracked())]
    assert chosen == [5, 10, 15]
    assert policy.kind is KeyframeKind.MAPPING


def test_little_overlap_gives_a_tracking_keyframe() -> None:
    policy = started()
    assert not policy.decide(2, Tracked(overlap=0.85))
    assert policy.decide(3, Tracked(overlap=0.75))
    assert policy.kind is KeyframeKind.TRACKING


def test_tracking_keyframes_keep_a_distance_unless_overlap_is_very_low() -> None:
    policy = started(KeyframeSettings(min_overlap=0.8, min_gap=2))
    assert not policy.decide(1, Tracked(overlap=0.75))
    assert policy.decide(1, Tracked(overlap=0.5))


def test_motion_counts_by_the_distance_of_the_scene() -> None:
    moved = se3_exp(np.array([0.15, 0, 0, 0, 0, 0]))
    assert not started().decide(1, Tracked(T_world_camera=moved, median_depth_m=2.0))
    assert started().decide(1, Tracked(T_world_camera=moved, median_depth_m=1.0))
    assert started().decide(1, Tracked(T_world_camera=se3_exp(np.radians([0, 0, 0, 0, 12, 0]))))


def test_limits_at_their_edges() -> None:
    def decides(gap: int, **tracked: object) -> bool:
        return started(KeyframeSettings(max_gap=5)).decide(gap, Tracked(**tracked))  # type: ignore[arg-type]

    def turned(degrees: float) -> np.ndarray:
        return se3_exp(np.radians([0, 0, 0, 0, degrees, 0]))

    def shifted(metres: float) -> np.ndarray:
        return se3_exp(np.array([metres, 0, 0, 0, 0, 0]))

    assert decides(2, overlap=0.799) and not decides(2, overlap=0.801)
    assert decides(1, overlap=0.599) and not decides(1, overlap=0.601)
    assert decides(5) and not decides(4)
    assert decides(1, T_world_camera=turned(10.01)) and not decides(1, T_world_camera=turned(9.99))
    assert decides(1, T_world_camera=shifted(0.2002)) and not decides(1, T_world_camera=shifted(0.1998))
