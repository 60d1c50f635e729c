"""Numbers that settings may have; the reader of a configuration checks them."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

Positive = Annotated[float, Meta(gt=0)]
"""More than 0."""
NotNegative = Annotated[float, Meta(ge=0)]
"""0 or more."""
Share = Annotated[float, Meta(gt=0, lt=1)]
"""Between 0 and 1."""
