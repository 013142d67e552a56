# SPDX-License-Identifier: Apache-2.0
"""Units in which files count time since 1970."""

from __future__ import annotations

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Unit -> seconds."""
EPOCH_DIGITS = {10: "s", 13: "ms", 16: "us", 19: "ns"}
"""Digits of a whole number that counts since 1970 (from 2001 to 2286) -> its unit."""
