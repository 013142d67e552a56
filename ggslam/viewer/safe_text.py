# SPDX-License-Identifier: Apache-2.0
"""Makes text of users and data sets safe for a page that renders Markdown with HTML."""

from __future__ import annotations


def plain(text: str) -> str:
    """Markdown that shows `text` as it is, on one line: whatever could be markup is written as character references.
    viser renders HTML within Markdown as it comes, frames and their scripts included, and names are anybody's."""
    words = " ".join(text.split())
    return "".join(f"&#{ord(c)};" if c.isascii() and not c.isalnum() and c != " " else c for c in words)
