"""Number types for settings of the simulator; the reader of a configuration checks their bounds."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import msgspec

Positive: TypeAlias = Annotated[float, msgspec.Meta(gt=0)]
"""More than 0."""
NotNegative: TypeAlias = Annotated[float, msgspec.Meta(ge=0)]
"""0 or more."""
Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
"""From 0 to 1."""
