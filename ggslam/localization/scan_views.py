# SPDX-License-Identifier: Apache-2.0
"""Describes a place as an upright laser scanner sees it: occupied heights above the floor, by direction and distance.

Space around the sensor is divided into layers of height, rings of distance (each a fixed factor wider than the one
within) and sectors of azimuth; a bit says whether anything was measured there. Bits do not depend on how dense points
are, so that views of scans and of maps compare. A turn of the sensor shifts the sectors: circular correlation by FFT
finds it, and magnitudes along the sectors do not change with it. These are the log-polar images and Fourier magnitudes
of image registration (Reddy and Chatterji, IEEE TIP 1996), and of scan matching by histograms (Weiss and von
Puttkamer, IAS 1995; Röfer, IROS 2002), over layers of occupancy instead of grey values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.localization.level import floor_height

SECTORS: Final = 60
"""Directions of a stored view."""
RINGS: Final = 20
"""Rings of a stored view."""
LAYERS: Final = (0.3, 1.0, 2.0, 3.5)
"""Heights above the floor, in metres, at which the layers of a stored view start. The last one is open, and below the
first is floor."""
NEAREST: Final = 1.0
"""Inner radius of a stored view, in metres from the sensor's axis."""
FARTHEST: Final = 60.0
"""Outer radius of a stored view, in metres."""
ROWS = len(LAYERS) * RINGS
CODE_BYTES = ROWS * SECTORS // 8

@dataclass(frozen=True)
class ScanView:
    """A view as it is stored: bits uint8 [CODE_BYTES], rows (layer by layer, ring by ring) of `SECTORS` bits each,
    counter-clockwise from +x."""

    code: np.ndarray
    floor: float
    """Height of the floor in the sensor's frame, metres (negative)."""


def view_of(points: np.ndarray) -> ScanView | None:
    """The view of level points [n, 3], metres, z up, about the sensor; None where they show no floor."""
    height = floor_height(points)
    return None if height is None else ScanView(code_of(points, height), height)


def code_of(points: np.ndarray, floor: float) -> np.ndarray:
    """The bits of level points [n, 3] about the sensor, with the floor at height `floor`; see `ScanView`."""
    across = np.hypot(points[:, 0], points[:, 1])
    layer = np.searchsorted(LAYERS, points[:, 2] - floor, side="right") - 1
    kept = (layer >= 0) & (across >= NEAREST) & (across < FARTHEST)
    x, y = points[kept, 0], points[kept, 1]
    ring = np.log(across[kept] / NEAREST) * (RINGS / np.log(FARTHEST / NEAREST))
    sector = (np.arctan2(y, x) / (2 * np.pi)) % 1.0 * SECTORS
    bits = np.zeros((len(LAYERS), RINGS, SECTORS), bool)
    bits[layer[kept], np.clip(ring.astype(np.int64), 0, RINGS - 1), sector.astype(np.int64) % SECTORS] = True
    return np.packbits(bits.reshape(-1))


class ViewIndex:
    """Finds the views most like one. Memory: 600 bytes of bits and 1.3 KB of a key for each view.

    Args:
        codes: uint8 [n, CODE_BYTES].
    """

    _FREQUENCIES = 4
    _SHORTLIST = 100

    def __init__(self, codes: np.ndarray) -> None:
        self.codes = codes
        bits = np.unpackbits(codes[:: max(1, len(codes) // 500)], axis=1).reshape(-1, ROWS, SECTORS)
        # What all places have, as ceilings and grounds, tells nothing.
        self._usual = bits.mean((0, 2)).astype(np.float32) if len(bits) else np.zeros(ROWS, np.float32)
        keys = [self._keys(self._spectra(codes[i : i + 500])) for i in range(0, len(codes), 500)]
        self._all_keys = np.concatenate(keys) if keys else np.zeros((0, ROWS * self._FREQUENCIES), np.float32)

    def __len__(self) -> int:
        return len(self.codes)

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        return self.codes.nbytes + self._all_keys.nbytes

    def query(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Views in the order of likeness.

        Args:
            codes: uint8 [m, CODE_BYTES], views of one scan from several places near the sensor.

        Returns:
            Their numbers int64 [k]; the correlations [k] (1: the same) of the view in `codes` that is most like each;
            which that is, int64 [k]; and turns [k] in radians: azimuth a in that view is a + turn in the stored one.
        """
        spectra, count = self._spectra(codes), min(self._SHORTLIST, len(self))
        likeness = self._keys(spectra) @ self._all_keys.T
        correlation, turn = np.full((len(codes), len(self)), -1.0), np.zeros((len(codes), len(self)))
        for row, spectrum in enumerate(spectra):
            numbers = np.argpartition(-likeness[row], count - 1)[:count] if count else np.zeros(0, np.int64)
            stored = self._spectra(self.codes[numbers])
            correlation[row, numbers], turn[row, numbers] = _correlate(stored, spectrum)
        which = correlation.argmax(0)
        each = np.arange(len(self))
        best = correlation[which, each]
        order = np.argsort(-best, kind="stable")
        order = order[best[order] > -1.0]
        return order, best[order], which[order], turn[which[order], order]

    def _spectra(self, codes: np.ndarray) -> np.ndarray:
        """Along the sectors, of what is unusual, complex [n, ROWS, SECTORS // 2 + 1]."""
        bits = np.unpackbits(codes, axis=1).reshape(len(codes), len(LAYERS), RINGS, SECTORS).astype(np.float32)
        bits -= self._usual.reshape(len(LAYERS), RINGS, 1)
        rings = 0.5 * bits
        rings[:, :, 1:] += 0.25 * bits[:, :, :-1]
        rings[:, :, :-1] += 0.25 * bits[:, :, 1:]
        blur = (0.5 + 0.5 * np.cos(2 * np.pi * np.arange(SECTORS // 2 + 1) / SECTORS)).astype(np.float32)
        return np.fft.rfft(rings.reshape(len(codes), ROWS, SECTORS), axis=2) * blur

    def _keys(self, spectra: np.ndarray) -> np.ndarray:
        """Unit vectors that do not depend on turns, float32 [n, ROWS * frequencies]."""
        first = spectra[:, :, : self._FREQUENCIES]
        # The sum of a row may be below what is usual; the other magnitudes are above 0.
        keys = np.abs(first)
        keys[:, :, 0] = first[:, :, 0].real
        keys = keys.reshape(len(spectra), -1).astype(np.float32)
        return keys / np.maximum(np.linalg.norm(keys, axis=1, keepdims=True), 1e-9)


def _correlate(stored: np.ndarray, spectrum: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Greatest normalised correlations [k] of spectra [k, ROWS, f] with one, and the turns [k] they have it at."""
    correlation = np.fft.irfft((stored * spectrum.conj()).sum(1), SECTORS, axis=1)
    correlation /= np.maximum(np.sqrt(_energy(stored) * _energy(spectrum[None])), 1e-9)[:, None]
    best, each = correlation.argmax(1), np.arange(len(stored))
    before, at, after = (correlation[each, (best + step) % SECTORS] for step in (-1, 0, 1))
    bend = np.minimum(before + after - 2 * at, -1e-9)
    return at, (best + np.clip((before - after) / (2 * bend), -0.5, 0.5)) * (2 * np.pi / SECTORS)


def _energy(spectra: np.ndarray) -> np.ndarray:
    """Sums of squares of what the spectra are of, [n]."""
    squares = np.abs(spectra) ** 2
    return (squares[:, :, 0] + 2 * squares[:, :, 1:-1].sum(2) + squares[:, :, -1]).sum(1) / SECTORS
