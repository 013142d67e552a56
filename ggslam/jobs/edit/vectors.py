# SPDX-License-Identifier: Apache-2.0
"""Numbers that people write."""

from __future__ import annotations

import numpy as np

from ggslam.errors import ConfigError


def read_vector(argument: str, text: str) -> tuple[float, float, float]:
    """Three finite numbers of a text like "0.1 0 -0.2"; raises ConfigError, which names the argument, for others."""
    try:
        x, y, z = (float(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise ConfigError(f'`{argument}`: expected three numbers like "0.1 0 -0.2", found {text!r}') from None
    if not np.isfinite([x, y, z]).all():
        raise ConfigError(f"`{argument}`: expected finite numbers, found {text!r}")
    return x, y, z
