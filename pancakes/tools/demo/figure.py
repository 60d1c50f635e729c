"""The look of the figures that demos leave beside their records, and an empty figure to draw them in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from pancakes.errors import PancakesError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK: Final = "#333333"
STYLE: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "font.size": 8,
        "axes.titlesize": 8.5,
        "axes.labelsize": 8,
        "legend.fontsize": 7.5,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "axes.linewidth": 0.6,
        "axes.edgecolor": INK,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "font.family": "DejaVu Sans",
    }
)
"""Settings of matplotlib, by name."""


@contextmanager
def drawing(width_in: float, height_in: float, **changes: Any) -> Iterator[Figure]:
    """Yield an empty figure; what is drawn within the block has the style of all demos.

    Args:
        width_in: its width, in inches.
        height_in: its height, in inches.
        changes: settings of matplotlib that differ from `STYLE`, with `_` for the dot: `legend_fontsize=7`.

    Raises:
        PancakesError: matplotlib is missing.
    """
    try:
        import matplotlib  # large: only when something is drawn
    except ImportError:
        raise PancakesError("the figure needs matplotlib: pip install 'pancakes-agents[demo]'") from None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context({**STYLE, **{name.replace("_", ".", 1): value for name, value in changes.items()}}):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
