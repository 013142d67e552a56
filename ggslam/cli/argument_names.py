# SPDX-License-Identifier: Apache-2.0
"""The library's messages name arguments, as `out`; on the command line they name options, as --out."""

from __future__ import annotations

import re

_OPTIONS = {
    "check": "--no-check", "full": "--full-map", "inpainting": "--inpaint",
    "latency": "--driving", "on_bad_frame": "--skip-bad-frames", "overrides": "--set",
    "recording": "--sequence", "rotation": "--rotate", "slice_height": "--slice", "topics": "--topic",
}  # fmt: skip
"""Options that are not called as their argument is."""
_ARGUMENT = re.compile(r"`([a-z][a-z_]*)`")


def option_of(argument: str) -> str:
    """The option of an argument: "--localize-only" of "localize_only"."""
    return _OPTIONS.get(argument, "--" + argument.replace("_", "-"))


def with_options(text: str) -> str:
    """A message with options in place of the arguments that it names in backticks."""
    return _ARGUMENT.sub(lambda found: option_of(found[1]), text)
