"""Topics: what is one, which topics a filter means, and topics that are made of a packet. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

LONGEST_BYTES: Final = 65535
SHARE: Final = "$share"
"""A filter that begins so is for a group of clients, each message for one of them."""
_PLACE: Final = re.compile(r"\{([^{}]*)\}")


def client_id_of(agent: str, part: str) -> str:
    """Return the name of a connection: no two agents, and no two services, have one, as a broker takes one of a name.

    A dash of a name is doubled, as a single one stands between the two: agent `a-b` with `c` is not `a` with `b-c`.
    """
    return "-".join(("pancakes", agent.replace("-", "--"), part.replace("-", "--")))


def fault_of_topic(topic: str) -> str:
    """Say why no message can be published to a topic; empty: one can."""
    if found := next((sign for sign in "+#" if sign in topic), ""):
        return f"{topic!r} is no topic: {found} stands only in what is subscribed to"
    if topic.startswith("$"):
        return f"{topic!r} is no topic to publish to: those that begin with $ are the broker's own"
    return _fault(topic, "topic")


def fault_of_filter(filter_: str) -> str:
    """Say why a filter cannot be subscribed to; empty: it can."""
    if filter_.split("/")[0] == SHARE:
        group, inner = _shared(filter_)
        if not group or not inner or any(sign in group for sign in "+#"):
            return f"{filter_!r} is no filter: a shared subscription reads $share/GROUP/FILTER"
        filter_ = inner
    levels = filter_.split("/")
    if any("#" in level and (level != "#" or number < len(levels) - 1) for number, level in enumerate(levels)):
        return f"{filter_!r} is no filter: # stands alone, behind the last /"
    if any("+" in level and level != "+" for level in levels):
        return f"{filter_!r} is no filter: + stands alone between two /"
    return _fault(filter_, "filter")


def _fault(topic: str, kind: str) -> str:
    if not topic:
        return f"a {kind} has at least one letter"
    if "\0" in topic:
        return f"{topic!r} is no {kind}: it has a zero byte"
    if len(topic.encode()) > LONGEST_BYTES:
        return f"{topic[:40]!r}... is longer than a {kind} may be, {LONGEST_BYTES} bytes"
    return ""


def fault_of_retained(filter_: str) -> str:
    """Say why what a broker has kept never comes for a filter (MQTT 5.0, 4.8.2); empty: it comes."""
    if filter_.startswith(f"{SHARE}/"):
        return f"retained = true says nothing of {filter_!r}: a broker sends what it has kept to no shared subscription"
    return ""


def _shared(filter_: str) -> tuple[str, str]:
    """Return the group of a shared subscription, `$share/GROUP/FILTER`, and its filter; else none, and the filter."""
    first, _, rest = filter_.partition("/")
    group, slash, inner = rest.partition("/")
    return (group, inner) if first == SHARE and slash else ("", filter_)


def means(filter_: str, topic: str) -> bool:
    """Return whether a filter means a topic (MQTT 5.0, 4.7 and 4.8.2)."""
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
    """Say why no topic can be made of a template with these places; empty: one can."""
    for name in _PLACE.findall(template):
        if name not in known:
            places = ", ".join(f"{{{place}}}" for place in known)
            return f"{template!r} has the place {{{name}}}; there are {places}"
    return fault_of_topic(filled(template, known))


def filled(template: str, values: Mapping[str, str]) -> str:
    """Return a template with its places, such as `{agent}`, filled in; signs that no topic may have become `_`."""

    def fill(found: re.Match[str]) -> str:
        return re.sub(r"[+#\0]", "_", values.get(found[1], found[0]))

    return _PLACE.sub(fill, template)
