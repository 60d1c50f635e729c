"""What agents answer that were asked all at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pancakes.control import Reply


@dataclass
class Survey:
    """What the agents say about themselves.

    Attributes:
        agents: the result of `Describe` of each that answered, by fleet and name.
        silent: a sentence for each that did not.
        asleep: those of these sentences whose agent had said that its network would sleep.
    """

    agents: list[dict[str, Any]] = field(default_factory=list)
    silent: list[str] = field(default_factory=list)
    asleep: list[str] = field(default_factory=list)


@dataclass
class Replies:
    """What the agents answer that were all asked the same.

    Attributes:
        replies: the name of each that answered, and its reply, by fleet and name.
        silent: a sentence for each that did not.
    """

    replies: list[tuple[str, Reply]]
    silent: list[str]
