"""A small writer of SVG figures: escaped text, short numbers, axes with round ticks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from markupsafe import Markup

Point = tuple[float, float]


@dataclass
class Drawing:
    """A figure of a size in its own units, which a page may scale; colours come from the page's classes."""

    width: float
    height: float
    label: str  # read out where the figure cannot be seen
    parts: list[str] = field(default_factory=list)

    def line(self, a: Point, b: Point, css: str) -> None:
        self.parts.append(f'<line class="{css}" x1="{_n(a[0])}" y1="{_n(a[1])}" x2="{_n(b[0])}" y2="{_n(b[1])}"/>')

    def circle(self, centre: Point, radius: float, css: str, title: str = "") -> None:
        self._shape(f'circle class="{css}" cx="{_n(centre[0])}" cy="{_n(centre[1])}" r="{_n(radius)}"', title)

    def polygon(self, points: Sequence[Point], css: str, title: str = "") -> None:
        path = " ".join(f"{_n(x)},{_n(y)}" for x, y in points)
        self._shape(f'polygon class="{css}" points="{path}"', title)

    def dots(self, points: Sequence[Point], css: str) -> None:
        """Many round dots as one element; the stroke width of the class is their diameter."""
        if points:
            path = "".join(f"M{_n(x)} {_n(y)}h0" for x, y in points)
            self.parts.append(f'<path class="{css}" stroke-linecap="round" d="{path}"/>')

    def rect(self, corner: Point, size: Point, css: str) -> None:
        place = f'x="{_n(corner[0])}" y="{_n(corner[1])}" width="{_n(size[0])}" height="{_n(size[1])}"'
        self.parts.append(f'<rect class="{css}" {place}/>')

    def text(self, at: Point, text: str, css: str = "tick", anchor: str = "start") -> None:
        self.parts.append(
            f'<text class="{css}" x="{_n(at[0])}" y="{_n(at[1])}" text-anchor="{anchor}">{escape(text)}</text>'
        )

    def render(self) -> Markup:
        """The figure as an element of a page."""
        box = f"0 0 {_n(self.width)} {_n(self.height)}"
        head = f'<svg viewBox="{box}" role="img" aria-label="{escape(self.label)}" xmlns="http://www.w3.org/2000/svg">'
        return Markup(head + "".join(self.parts) + "</svg>")

    def _shape(self, element: str, title: str) -> None:
        self.parts.append(
            f"<{element}><title>{escape(title)}</title></{element.split()[0]}>" if title else f"<{element}/>"
        )


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round values inside an interval, about `count` of them."""
    step = round_up((high - low) / max(count, 1))
    first = int(np.ceil(low / step - 1e-9))
    return [step * i for i in range(first, int(np.floor(high / step + 1e-9)) + 1)]


def round_up(value: float) -> float:
    """The next 1, 2 or 5 times a power of ten."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(m for m in (1, 2, 5, 10) if m * power >= value * (1 - 1e-9)) * power)


def round_down(value: float) -> float:
    """The last 1, 2 or 5 times a power of ten."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value) + 1e-9)
    return float(next(m for m in (5, 2, 1) if m * power <= value * (1 + 1e-9)) * power)


def short(value: float) -> str:
    """A number without needless digits, thousands set apart."""
    text = f"{value:,.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text.replace("-", "\N{MINUS SIGN}").replace(",", "\N{NARROW NO-BREAK SPACE}")


def _n(value: float) -> str:
    return f"{value:.1f}".rstrip("0").rstrip(".")
