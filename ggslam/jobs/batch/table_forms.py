# SPDX-License-Identifier: Apache-2.0
"""Text of a table's cells in the forms that people paste."""

from __future__ import annotations

import math
import re


def number_text(mean: float, spread: float, digits: int, plus_minus: str, signed: bool = False) -> str:
    """A score with its spread; a dash where there is none."""
    if math.isnan(mean):
        return "–"
    text = f"{mean:+.{digits}f}" if signed else f"{mean:.{digits}f}"
    return text + ("" if math.isnan(spread) else f"{plus_minus}{spread:.{digits}f}")


_LATEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", "–": "--", "±": r"$\pm$", "Δ": r"$\Delta$",
}  # fmt: skip


def latex(text: str) -> str:
    """A cell's text; a name cannot become a command."""
    return "".join(_LATEX.get(character, character) for character in one_line(text))


def markdown(text: str) -> str:
    """A cell's text; a name cannot become HTML, a link or another cell."""
    return re.sub(r"([\\`*\[\]|])", r"\\\1", one_line(text)).replace("<", "&lt;")


def one_line(text: str) -> str:
    """A text without ends of lines."""
    return " ".join(text.split())
