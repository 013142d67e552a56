# SPDX-License-Identifier: Apache-2.0
"""`python -m ggslam`: the command line."""

from __future__ import annotations

from ggslam.cli.main import main

main()
