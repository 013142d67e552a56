# SPDX-License-Identifier: Apache-2.0
"""Exposures of the keyframes relative to the map, and keyframes whose colours are not used."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ggslam.errors import FormatError
from ggslam.mapping.exposure import ExposureAdam
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.settings import ExposureSettings
from ggslam.rendering.exposure import (
    ExposureTuning,
    Seen,
    SeenAgain,
    change_of,
    frame_weights,
    identity_exposure,
    is_lit,
    relative_sharpness,
    shows_otherwise,
    typical_gain,
    without_exposure,
)
from ggslam.system.plurals import quantity
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class KeyframeExposureTuning(Tuning):
    """When the colours of a keyframe are not used."""

    min_keyframes = 3
    """Fewest known exposures from which a typical one is computed."""
    overexposed_gain = 1.1
    """Gain from which saturated pixels of a keyframe are not compared: the map may be brighter there."""
    min_contrast = 0.5
    """Smallest contrast between neighbouring pixels, relative to the map's, of a keyframe in focus."""


@savable(formerly="ggslam.mapping.cpu.keyframe_exposures.KeyframeExposures")
class KeyframeExposures:
    """Exposures of the keyframes of one mapper, by number.

    Args:
        settings: see there.

    Attributes:
        optimizers: of the exposures.
        changed: whether a keyframe has an anchor: as soon as one has, those that follow are compared with the map's.
        known: whether an exposure was measured, or is the map's own.
        blind: whether colours tell nothing: the image is nearly black, saturated, or much less sharp than the map,
            and others show that there is more to see.
        found_lit: whether a keyframe has shown colours; those before are blind.
    """

    optimizers: list[ExposureAdam]
    known: list[bool]
    blind: list[bool]

    def __init__(self, settings: ExposureSettings) -> None:
        self.settings = settings
        self.optimizers = []
        self.changed = False
        self.known = []
        self.blind = []
        self.found_lit = False

    def check(self, count: int) -> None:
        """Raises FormatError if these are not of so many keyframes: they may come from a file."""
        counts = [len(self.optimizers), len(self.known), len(self.blind)]
        if counts != [count] * 3:
            raise FormatError(f"exposures: expected those of {quantity(count, 'keyframe')}, found {counts}")

    def load(self, keyframes: Sequence[Keyframe]) -> None:
        """Starts with keyframes of an earlier run: their exposures are what they are, and stay about there."""
        count = len(keyframes)
        self.optimizers = [ExposureAdam(self.settings) for _ in keyframes]
        for optimizer, keyframe in zip(self.optimizers, keyframes, strict=True):
            optimizer.anchor, optimizer.measured = keyframe.exposure.copy(), keyframe.exposure.copy()
        self.changed = any(optimizer.is_anchored for optimizer in self.optimizers)
        self.known, self.blind, self.found_lit = [True] * count, [False] * count, count > 0

    def add(self) -> None:
        """A keyframe is about to follow."""
        self.optimizers.append(ExposureAdam(self.settings))
        self.known.append(False)
        self.blind.append(False)

    def lights_up(self, keyframe: Keyframe, seen: Seen | None) -> bool:
        """Whether a new keyframe is the first to show colours, of a map that has none so far: it is to take them from
        there. If it has itself none it is blind.

        Args:
            keyframe: the new one.
            seen: what the map shows where the keyframe looks; None: there is none.
        """
        if not self.settings.compensate:
            return False
        lit = is_lit(keyframe.color)
        if self.found_lit:
            self.blind[keyframe.index] = not lit and _contradicts(keyframe, seen)
            return False
        self.found_lit = lit
        if not lit or keyframe.index == 0 or not _contradicts(keyframe, seen):
            self.known[keyframe.index] = lit
            return False
        self.blind[: keyframe.index] = [True] * keyframe.index
        self.known[keyframe.index] = True
        return True

    def compensate(self, keyframe: Keyframe, seen: Seen, keyframes: Sequence[Keyframe]) -> np.ndarray:
        """A keyframe seen with another exposure than the map gets what is measured; its colours [H, W, 3] as the map's
        exposure would have shown them.

        Args:
            keyframe: the new one.
            seen: what the map shows where the keyframe looks.
            keyframes: those before.
        """
        if not self.settings.compensate or self.blind[keyframe.index] or not self.found_lit:
            return keyframe.color
        found = seen.measure(keyframe.color)
        if found is None:
            return keyframe.color
        self.known[keyframe.index] = True
        self.optimizers[keyframe.index].measured = found
        if not self.changed and abs(np.log(change_of(found))) > self.settings.change:
            for earlier in keyframes:
                self._anchor(earlier)
            self.changed = True
        return self._anchor(keyframe) if self.changed else keyframe.color

    def _anchor(self, keyframe: Keyframe) -> np.ndarray:
        """Gives a keyframe the exposure that was measured, if it differs from the map's; returns as `compensate`."""
        optimizer = self.optimizers[keyframe.index]
        measured = optimizer.measured
        if np.abs(np.log(measured[:, 0])).max() < self.settings.least:
            return keyframe.color
        keyframe.exposure, optimizer.anchor = measured.copy(), measured
        return without_exposure(keyframe.color, measured)

    def measure_again(self, keyframe: Keyframe, seen: SeenAgain) -> None:
        """A keyframe of a map that has been trained since gets what is measured against it, where exposures changed;
        if the map is much sharper than its image it is blind."""
        if self.blind[keyframe.index]:
            return
        found = seen.measure(keyframe.color) if self.changed else None
        if found is not None:
            self.known[keyframe.index] = True
            keyframe.exposure, self.optimizers[keyframe.index].anchor = found.copy(), found
        self.blind[keyframe.index] = (
            relative_sharpness(keyframe.color, seen, keyframe.exposure) < KeyframeExposureTuning.min_contrast
        )

    def is_exposed(self, keyframe: Keyframe) -> bool:
        """Whether a keyframe has an exposure of its own."""
        return self.settings.enabled or self.optimizers[keyframe.index].is_anchored

    def usable_pixels(self, keyframe: Keyframe) -> np.ndarray | None:
        """Where the colours of a keyframe tell something, bool [H, W]; None: everywhere."""
        if self.blind[keyframe.index]:
            return np.zeros(keyframe.color.shape[:2], bool)
        if self.is_exposed(keyframe) and change_of(keyframe.exposure) > KeyframeExposureTuning.overexposed_gain:
            return unsaturated_pixels(keyframe.color)
        return None

    def typical(self, keyframes: Sequence[Keyframe]) -> np.ndarray | None:
        """Median gain against the map, [3], over the frames that the keyframes stand for. None if the exposure did not
        change, too little is known, or the map was made before: it keeps what it was trained with."""
        if not self.changed or any(keyframe.frame_index == FROM_EARLIER_RUN for keyframe in keyframes):
            return None
        weights = frame_weights([keyframe.frame_index for keyframe in keyframes])
        told = [k.index for k in keyframes if self.known[k.index] and not self.blind[k.index]]
        if len(told) < KeyframeExposureTuning.min_keyframes:
            return None
        return typical_gain([keyframes[number].exposure[:, 0] for number in told], weights[told])

    def follow(self, gain: np.ndarray, keyframes: Sequence[Keyframe]) -> None:
        """The map became `gain` [3] times as bright: every exposure is against that from here on."""
        for keyframe in keyframes:
            optimizer = self.optimizers[keyframe.index]
            keyframe.exposure = _against(keyframe.exposure, gain)
            optimizer.anchor, optimizer.measured = _against(optimizer.anchor, gain), _against(optimizer.measured, gain)
            optimizer.first[:, 0] *= gain  # gradients with respect to a gain are as large as the map is bright
            optimizer.second[:, 0] *= gain**2


def unsaturated_pixels(color: np.ndarray) -> np.ndarray:
    """Pixels of an image uint8 [H, W, 3] of which no channel is saturated, bool [H, W]."""
    return np.asarray((color < ExposureTuning.bright * 255).all(2))


def _contradicts(keyframe: Keyframe, seen: Seen | None) -> bool:
    """Whether a keyframe shows another scene than the map where it looks."""
    return seen is not None and shows_otherwise(keyframe.color, seen.pictures())


def _against(exposure: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """An exposure [3, 2] against a map that is `gain` times as bright."""
    out = exposure / np.stack([gain, np.ones(3)], axis=1)
    return out if np.abs(out - identity_exposure()).max() > 1e-6 else identity_exposure()
