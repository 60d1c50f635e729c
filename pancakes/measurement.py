"""The control packet that measures what an agent's processor time goes to; `pancakes.control` has the others."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.packet import packet_type

SHORTEST_S: Final = 0.1
LONGEST_S: Final = 600.0
"""The shortest and the longest measurement, in seconds of host time."""


@packet_type("measure")
class Measure(msgspec.Struct, frozen=True):
    """Measures for some time what the processor time of an agent goes to; the reply comes at the end.

    The `result` is a mapping, with all times in seconds of processor time, of the measurement alone:

    - `agent`; `speed` (mission seconds for each second of host time); `span_s` (host time that it took); `processor_s`
      (of the whole process); `turns` and `turn_s` (of all its actors);
    - `host`: its computer: `id` (the same for all agents on it), `processors` (how many), `busy_share` (of all of
      them), `yardstick_s` (a fixed piece of Python took so long: how fast they are);
    - `battery`: `before` and `after`, what was left of it, 0 to 1; None where it has none or has not read it;
    - `tasks`: a mapping for each task: `service`, `task`, `type`, `state`, `task_id` (empty where it cannot move),
      `turns`, `turn_s`, and `timers`, each with `timer`, `rate_hz`, `ticks`, `missed`, `tick_s`, `tick_s2` (sum of the
      squares of its ticks' times).

    Turns are timed while something measures, and at no other time. In virtual time it is refused.

    Attributes:
        for_s: how long, in host time.
    """

    for_s: float = 5.0
