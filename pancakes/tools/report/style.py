"""How pictures look: sizes for a paper's columns, colours that colour-blind people can tell apart, units on axes."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.tools.report.findings import Findings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#8c6d31", "#7f7f7f")
"""Okabe and Ito's, without the yellow, which is hardly seen on white, and two more."""
DASHES: Final = ((0, ()), (0, (4, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.2, 1.2, 1.2)))
MARKERS: Final = ("^", "s", "D", "v", "o", "P", "X", "*")
INK, FAINT = "#333333", "#9a9a9a"
COLUMN_IN: Final = 3.5
"""The width of a column of a paper, in inches."""
WIDE_IN: Final = 7.16
DPI: Final = 300
ON_SCREEN: Final = 1.9
"""Pixels of a page for each point of a picture: a screen is read from further away than paper."""


@dataclass(frozen=True)
class Picture:
    """A picture, drawn.

    Attributes:
        name: of its files.
        caption: what it shows.
        svg: the picture as SVG, for a page: ink takes the colour of the text around it.
    """

    name: str
    caption: str
    svg: str


class Palette:
    """Gives each name one colour and one marker throughout a report.

    Args:
        names: the names; the first ones get the colours that are easiest to tell apart.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._places = {name: place for place, name in enumerate(dict.fromkeys(names))}

    def colour(self, name: str) -> str:
        """Returns the colour of a name."""
        return COLOURS[self._place(name) % len(COLOURS)]

    def marker(self, name: str) -> str:
        """Returns the marker of a name."""
        return MARKERS[self._place(name) % len(MARKERS)]

    def _place(self, name: str) -> int:
        return self._places.setdefault(name, len(self._places))


@contextmanager
def figure(width_in: float, height_in: float) -> Iterator[Figure]:
    """A figure in the report's style, for as long as it is drawn and saved."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    style = resources.files("pancakes.tools.report").joinpath("static/report.mplstyle")
    with resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        made = Figure(figsize=(width_in, height_in), layout="constrained")
        FigureCanvasAgg(made)
        yield made


def save(made: Figure, out: Path, name: str, caption: str) -> Picture:
    """Writes a figure as PNG and SVG, and returns it for the page.

    Raises:
        OSError: the files cannot be written.
    """
    import matplotlib

    made.savefig(out / f"{name}.png", dpi=DPI)
    buffer = io.StringIO()
    # The same recording gives the same bytes.
    with matplotlib.rc_context({"svg.hashsalt": name}):
        made.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True)
    svg = buffer.getvalue()
    (out / f"{name}.svg").write_text(svg, encoding="utf-8")
    return Picture(name, caption, _for_page(svg, name))


def _for_page(svg: str, name: str) -> str:
    """Returns an SVG that can stand in a page beside others: its own names only, and the page's ink."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r' width="([\d.]+)pt" height="[\d.]+pt"', _as_wide_as_room, svg, count=1)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' id="(figure|axes|patch|line2d|matplotlib\.axis|[xy]tick|text|legend|\w+Collection)_\d+"', "", svg)
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', svg)
    svg = re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', svg)
    svg = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", svg)
    return svg.replace(INK, "currentColor")


def _as_wide_as_room(size: re.Match[str]) -> str:
    broad = ' class="broad"' if float(size[1]) > 72 * (COLUMN_IN + WIDE_IN) / 2 else ""
    return f'{broad} style="max-width: {float(size[1]) * ON_SCREEN:.0f}px"'


def time_axis(axes: Axes, findings: Findings) -> None:
    """Makes the horizontal axis one of the recording's time."""
    axes.set_xlim(findings.begin_s, max(findings.end_s, findings.begin_s + 1e-3))
    axes.set_xlabel(f"{findings.time.name} [s]")


def plot_line(axes: Axes, points: Sequence[tuple[Any, ...]], number: int, colour: str, label: str, **how: Any) -> None:
    """Draws a line through points; its dashes follow from its number among the lines of a colour."""
    dashes = DASHES[number % len(DASHES)]
    axes.plot([x for x, _ in points], [y for _, y in points], ls=dashes, color=colour, label=label, **how)


def label_rows(axes: Axes, labels: Sequence[str]) -> None:
    """Names the rows of a picture, from the top downwards."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def label_log(axis: Axis) -> None:
    """Writes plain numbers along a logarithmic axis, once everything on it has been drawn."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    low, high = axis.get_view_interval()
    if high < 30 * low:  # hardly a power of ten on it
        digits = "234568" if high < 5 * low else "25"
        axis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in digits else ""))
    else:
        axis.set_minor_formatter(NullFormatter())


def unit_of_bytes(largest: float) -> tuple[float, str]:
    """Returns by what to divide bytes a second so that figures are short, and the unit."""
    for factor, unit in ((1e6, "MB/s"), (1e3, "kB/s")):
        if largest >= factor:
            return factor, unit
    return 1.0, "B/s"
