"""What `pancakes doctor` looks at in guarded tasks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pancakes.tools.cli.verbs.finding import Finding


def check_guards(rows: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Looks at guarded tasks: whether each would outlive its agent, and whether one stands still.

    Args:
        rows: what all agents answer to `Guarding`.
    """
    tasks: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        tasks.setdefault(row["task_id"], []).append(row)
    for task_id, known in sorted(tasks.items()):
        newest = max(_number(row) for row in known)
        owners = [row for row in known if "guardians" in row and _number(row) == newest]
        name = task_id.partition("/")[2]
        if owners:
            yield from _check_owned(owners[0], known)
        elif not any(row["lease"] for row in known) and any(row["wanted"] for row in known):
            text = f"is run by no agent: its owner {known[0]['owner']} is silent"
            yield Finding("error", task_id, text, f"pancakes task take {known[0]['agent']}/{name} has it taken over")
        elif any(row["wanted"] for row in known):
            yield from _awaited(task_id, [row for row in known if row["lease"]])


def is_awaited(row: dict[str, Any]) -> bool:
    """Returns whether a guardian only waits for the end of a lease: an owner that lives renews it long before."""
    return row["lease"] and row["silent_s"] > row["lease_left_s"]


def _awaited(task_id: str, leased: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Says what is waited for until a task can be taken over; a guardian that has begun again waits a whole lease."""
    if not all(map(is_awaited, leased)):
        return
    names = ", ".join(f"{row['agent']} ({row['lease_left_s']:.0f} s)" for row in leased)
    text = f"is run by no agent that answers: guardians wait until the lease of {leased[0]['owner']} is over: {names}"
    yield Finding("warning", task_id, text, "another agent goes on with it then, or its owner if that is back")


def _number(row: dict[str, Any]) -> int:
    return int(row["epoch"].partition("@")[0])


def _check_owned(owner: dict[str, Any], known: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    about, guardians = f"{owner['agent']}/{owner['task_id'].partition('/')[2]}", owner["guardians"]
    silent = [name for name in guardians if name not in {row["agent"] for row in known}]
    if owner["wanted"] and not owner["permit_s"]:
        text = "stands still: more than half of its guardians do not answer it"
        yield Finding("error", about, text, f"see which: pancakes task guards {owner['agent']}")
    elif len(guardians) < owner["guard"]:
        text = f"is to be guarded by {owner['guard']} agents, and is by {len(guardians)}: it does not outlive its agent"
        yield Finding("warning", about, text, "link it to more agents that may guard it; a witness will do")
    elif silent:
        text = f"has a guardian that does not answer: {', '.join(silent)}"
        yield Finding("warning", about, text, "see whether it runs; after a minute another agent takes its place")
    yield from _check_machine(about, owner)


def _check_machine(about: str, owner: dict[str, Any]) -> Iterator[Finding]:
    if devices := ", ".join(owner.get("no_dead_man", ())):
        text = f"commands {devices}, whose hardware does not hold by itself: it goes on as it was where its agent dies"
        yield Finding("warning", about, text, "docs/writing-a-driver.md says what a dead-man switch must do")
    if steps := owner.get("clock_steps", 0):
        times = "once" if steps == 1 else f"{steps} times"
        text = f"stood still {times} because the time of day of {owner['agent']} was set forward"
        yield Finding("warning", about, text, "have its clock set before the agent starts")
