"""What `pancakes doctor` looks at in the fences of actuators."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pancakes.tools.cli.verbs.finding import Finding


def check_fences(rows: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Looks for tasks that an actuator refuses, because it has seen a higher epoch of them than runs now.

    A lower one is as it should be: the next command of the task raises it.

    Args:
        rows: what `pancakes task fence` shows of each actuator.
    """
    for row in rows:
        if row["obeyed"] is False and _epoch(row["seen"]) > _epoch(row["owner_has"]):
            text = (
                f"refuses {row['task_id']}, which {row['owner']} has under epoch {row['owner_has']}: it has seen epoch"
                f" {row['seen']}, brought by {row['brought_by']}"
            )
            advice = f"see that the task runs once, then: pancakes task fence {row['actuator']} --set {row['task_id']}"
            yield Finding("error", row["actuator"], text, advice)


def _epoch(text: str) -> tuple[int, str]:
    number, _, minter = text.partition("@")
    return int(number), minter
