"""The demos of this distribution, as the launcher finds them by entry point (`pancakes.demos`)."""

from __future__ import annotations
