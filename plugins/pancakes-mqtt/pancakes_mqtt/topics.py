"""Topics: check them, match filters, and make topics for packets. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

LONGEST_BYTES: Final = 65535
SHARE: Final = "$share"
"""The prefix of a filter for a group of clients, of which one gets each message."""
_PLACE: Final = re.compile(r"\{([^{}]*)\}")


def client_id_of(agent: str, part: str) -> str:
    """Return the name of a connection, different for each agent and part: a broker accepts one of each name.

    Dashes in a name are doubled, because a single one separates the two: agent `a-b` with `c` is not `a` with `b-c`.
    """
    return "-".join(("pancakes", agent.replace("-", "--"), part.replace("-", "--")))


def fault_of_topic(topic: str) -> str:
    """Return why messages cannot be published to a topic; empty: they can."""
    if found := next((sign for sign in "+#" if sign in topic), ""):
        return f"{topic!r} is not a topic: only filters may contain {found}"
    if topic.startswith("$"):
        return f"{topic!r} is not a topic to publish to: topics that begin with $ belong to the broker"
    return _fault(topic, "topic")


def fault_of_filter(filter_: str) -> str:
    """Return why a filter cannot be subscribed to; empty: it can."""
    if filter_.split("/")[0] == SHARE:
        group, inner = _shared(filter_)
        if not group or not inner or any(sign in group for sign in "+#"):
            return f"{filter_!r} is not a filter: a shared subscription has the form $share/GROUP/FILTER"
        filter_ = inner
    levels = filter_.split("/")
    if any("#" in level and (level != "#" or number < len(levels) - 1) for number, level in enumerate(levels)):
        return f"{filter_!r} is not a filter: # must be alone after the last /"
    if any("+" in level and level != "+" for level in levels):
        return f"{filter_!r} is not a filter: + must be alone between two /"
    return _fault(filter_, "filter")


def _fault(topic: str, kind: str) -> str:
    if not topic:
        return f"a {kind} must have at least one letter"
    if "\0" in topic:
        return f"{topic!r} is not a {kind}: it has a zero byte"
    if len(topic.encode()) > LONGEST_BYTES:
        return f"{topic[:40]!r}... is longer than a {kind} may be, {LONGEST_BYTES} bytes"
    return ""


def fault_of_retained(filter_: str) -> str:
    """Return why retained messages never come for a filter (MQTT 5.0, 4.8.2); empty: they do."""
    if filter_.startswith(f"{SHARE}/"):
        return f"retained = true has no effect on {filter_!r}: shared subscriptions get no retained messages"
    return ""


def _shared(filter_: str) -> tuple[str, str]:
    """Return the group and filter of a shared subscription, `$share/GROUP/FILTER`; else no group, and the filter."""
    first, _, rest = filter_.partition("/")
    group, slash, inner = rest.partition("/")
    return (group, inner) if first == SHARE and slash else ("", filter_)


def means(filter_: str, topic: str) -> bool:
    """Return whether a filter matches a topic (MQTT 5.0, 4.7 and 4.8.2)."""
    wanted, levels = _shared(filter_)[1].split("/"), topic.split("/")
    if topic.startswith("$") and wanted[0] in ("+", "#"):
        return False
    for number, level in enumerate(wanted):
        if level == "#":
            return True
        if number >= len(levels) or (level != "+" and level != levels[number]):
            return False
    return len(wanted) == len(levels)


def fault_of_template(template: str, known: Mapping[str, str]) -> str:
    """Return why a template with these placeholders cannot make a topic; empty: it can."""
    for name in _PLACE.findall(template):
        if name not in known:
            places = ", ".join(f"{{{place}}}" for place in known)
            return f"{template!r} has the placeholder {{{name}}}; known are {places}"
    return fault_of_topic(filled(template, known))


def filled(template: str, values: Mapping[str, str]) -> str:
    """Return a template with its placeholders, such as `{agent}`, filled in; invalid characters become `_`."""

    def fill(found: re.Match[str]) -> str:
        return re.sub(r"[+#\0]", "_", values.get(found[1], found[0]))

    return _PLACE.sub(fill, template)
