# SPDX-License-Identifier: Apache-2.0
"""Tables as CSV in which no spreadsheet takes text for a formula.

A cell that begins with `=`, `+`, `-` or `@` is a formula to Excel, LibreOffice and Google Sheets, and names of
recordings and objects come from anywhere. Source: OWASP, "CSV Injection".
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\n", "＝", "＋", "－", "＠")


def csv_text(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as text, one line per row.

    Args:
        head: names of the columns.
        rows: cells; None is written as an empty one, numbers as Python prints them. Texts that are no number and begin
            as a formula does get an apostrophe in front.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([_plain(name) for name in head])
    writer.writerows([_plain(cell) for cell in row] for row in rows)
    return text.getvalue()


def _plain(cell: Any) -> Any:
    if not isinstance(cell, str) or is_number(cell):
        return cell
    cell = cell.replace("\r", "\n")  # Python's writer does not quote \r, at which readers begin a new row
    return f"'{cell}" if cell.lstrip(" ").startswith(_FORMULA_STARTS) else cell


def is_number(text: str) -> bool:
    """Whether Python reads a text as a float."""
    try:
        float(text)
    except ValueError:
        return False
    return True
