"""Motions as an array that shows itself in a notebook."""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import Any

import numpy

from ._errors import StrideError

HEIGHT = 520
"""Pixels of the viewer in a notebook."""


class Motions(numpy.ndarray[Any, numpy.dtype[numpy.float32]]):
    """Positions in metres as ``[motions, frames, joints, 3]``.

    A notebook shows the motions as a page that plays them. The page holds all that it needs, so that it also plays in a saved notebook.
    Parts and results of arithmetic are plain arrays without a page.
    """

    _page: Callable[[], str] | None

    def __array_finalize__(self, obj: object) -> None:
        self._page = None

    def _repr_html_(self) -> str | None:
        if self._page is None:
            return None
        try:
            page = html.escape(self._page())
        except StrideError:
            # The array is still worth showing.
            return None
        style = f"width: 100%; height: {HEIGHT}px; border: 0"
        return f'<iframe title="Motions" sandbox="allow-scripts" style="{style}" srcdoc="{page}"></iframe>'


def motions(positions: list[Any], page: Callable[[], str]) -> Motions:
    """Motions of equal length, with the page that plays them."""
    found = numpy.stack(positions).astype(numpy.float32, copy=False).view(Motions)
    found._page = page
    return found
