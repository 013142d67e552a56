# SPDX-License-Identifier: Apache-2.0
"""Pieces of HTML pages that need nothing beside them: no network, no files, no script to be read.

Functions take plain text, which they escape, and give HTML; `Html` is text that is HTML already.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import RunFolderError
from ggslam.reporting.plot_files import svg
from ggslam.reporting.plots import Plot, draw
from ggslam.system.tuning import Tuning

_FOLDER = Path(__file__).parent


class PageTuning(Tuning):
    """How pictures are stored in a page."""

    jpeg_quality = 82
    """Quality of JPEG, of 100."""


class Html(str):
    """Text that is HTML already."""


def escape(text: str) -> Html:
    """Plain text as HTML; `Html` as it is."""
    return text if isinstance(text, Html) else Html(html.escape(text, quote=True))


def join(parts: Iterable[str]) -> Html:
    """Pieces one after the other."""
    return Html("".join(escape(part) for part in parts))


def tag(name: str, *content: str, **attributes: str) -> Html:
    """An element; `class_` is the attribute class."""
    given = "".join(f' {key.rstrip("_")}="{html.escape(value, quote=True)}"' for key, value in attributes.items())
    return Html(f"<{name}{given}>{join(content)}</{name}>")


def section(title: str, anchor: str, *content: str) -> Html:
    """A part of the page with a heading."""
    return tag("section", tag("h2", title), *content, id=anchor)


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], sorts: bool = False, text_columns: Sequence[int] = ()
) -> Html:
    """A table that scrolls within itself where it is too wide; the first column names the rows.

    Args:
        head: headings.
        rows: of cells; a cell that is an element `td` already stays one.
        sorts: whether a click on a heading sorts the rows.
        text_columns: numbers of the columns that are text, not numbers.
    """
    css = {k: {"class_": "text"} for k in text_columns}

    def cell(number: int, value: str) -> Html:
        if isinstance(value, Html) and value.startswith("<td"):
            return value
        return tag("th", value, scope="row") if number == 0 else tag("td", value, **css.get(number, {}))

    top = tag("tr", *(tag("th", name, scope="col", **css.get(k, {})) for k, name in enumerate(head)))
    body = join(tag("tr", *(cell(k, value) for k, value in enumerate(row))) for row in rows)
    whole = tag("table", tag("thead", top), tag("tbody", body), **({"class_": "sorts"} if sorts else {}))
    return tag("div", whole, class_="scroll", tabindex="0")


def tiles(entries: Iterable[tuple[str, str, str]]) -> Html:
    """Large numbers: (value, unit, what it is)."""
    return tag(
        "div",
        *(tag("div", tag("b", value, " ", tag("small", unit)), tag("span", name), class_="tile")
          for value, unit, name in entries),
        class_="tiles",
    )  # fmt: skip


def figures(plots: Iterable[Plot]) -> Html:
    """Plots beside each other, as many as there is room for; those without data are left out."""
    return tag("div", *(figure(plot) for plot in plots if plot.has_data()), class_="plots")


def figure(plot: Plot) -> Html:
    """One plot under its title."""
    drawn = Html(svg(draw(plot, height=420 if plot.equal else 300), plot))
    note = [tag("figcaption", plot.note)] if plot.note else []
    return tag("figure", tag("h3", plot.title), drawn, *note)


def image(picture: np.ndarray, words: str) -> Html:
    """A picture, uint8 [H, W, 3], within the page; `words` describe it."""
    good, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, PageTuning.jpeg_quality])
    if not good:
        raise RunFolderError(f"picture of {words}: cannot be encoded")
    height, width = picture.shape[:2]
    source = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
    size = f'width="{width}" height="{height}"'
    return Html(f'<img src="{source}" alt="{html.escape(words, quote=True)}" {size} loading="lazy">')


def cells(pictures: Iterable[tuple[str, np.ndarray]], columns: int = 3) -> Html:
    """Pictures with captions in rows of 2 to 4; of four only two on narrow windows."""
    return tag(
        "div", *(tag("figure", image(picture, words), tag("figcaption", words)) for words, picture in pictures),
        class_=f"cells columns{columns}",
    )  # fmt: skip


def definitions(entries: Iterable[tuple[str, str]]) -> Html:
    """Words and what they mean."""
    return tag("dl", *(join([tag("dt", word), tag("dd", meaning)]) for word, meaning in entries))


def bullets(lines: Iterable[str]) -> Html:
    """A list."""
    return tag("ul", *(tag("li", line) for line in lines))


def page(title: str, lead: str, content: Sequence[Html], links: Sequence[tuple[str, str]], footer: str) -> str:
    """A whole page.

    Args:
        title: also that of the window.
        lead: a line below it.
        content: the parts.
        links: (anchor, title) of the parts.
        footer: the last line.
    """
    navigation = tag("nav", *(tag("a", words, href=f"#{anchor}") for anchor, words in links))
    header = tag("header", tag("h1", title), tag("p", lead, class_="lead"), navigation)
    body = tag("main", header, *content, tag("footer", footer))
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_file('page.css')}</style>"
    )
    script = f"<script>{_file('page.js')}</script>"
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>{body}{script}</body></html>\n'


@lru_cache
def _file(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")
