"""What a migration rule gets wrong by itself, or about the tasks beside it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite

from pancakes.mesh.migration.cost import faults_of_weights
from pancakes.mesh.migration.rule import MigrationRule
from pancakes.runtime.config.tables import TaskConfig
from pancakes.runtime.foundation.suggestion import suggestion


def faults_of_rule(rule: MigrationRule, task: str, tasks: Mapping[str, TaskConfig]) -> Iterator[tuple[str, str, str]]:
    """Yields (key, problem, suggestion) for each mistake in the rule of a task.

    An empty key means the rule as a whole; `cost.NAME` is a key of the table `cost`.

    Args:
        rule: the rule.
        task: the name of the task that it moves.
        tasks: all tasks of the configuration.
    """
    if not rule.when:
        yield "when", "is empty: name the type of the packets to watch, such as 'battery'", ""
    if rule.below is None and rule.above is None:
        yield "", "needs a bound: below, above or both", ""
    for name, bound in (("below", rule.below), ("above", rule.above)):
        if bound is not None and not isfinite(bound):
            yield name, f"expected a finite number, not {bound:g}", ""
        elif bound is not None and rule.field == "level" and not 0 <= bound <= 1:
            yield name, f"expected a number from 0 to 1 (a level is a share), not {bound:g}", ""
    if rule.below is not None and rule.above is not None and rule.below > rule.above:
        yield "below", f"is more than above ({rule.above:g}), so that the task would always move", ""
    if rule.cost == "":
        yield "cost", "is empty: name a cost function, such as 'tasks'", ""
    elif not isinstance(rule.cost, str):
        for name, problem in faults_of_weights(rule.cost):
            yield f"cost.{name}" if name else "cost", problem, ""
    if not (isfinite(rule.again_s) and rule.again_s > 0):
        yield "again_s", f"expected a number of seconds > 0, not {rule.again_s:g}", ""
    for key, name, why in (
        ("then", rule.then, "which has just left"),
        ("otherwise", rule.otherwise, "which is stopped then"),
    ):
        if name == task:
            yield key, f"names the task itself, {why}", ""
        elif name and name not in tasks:
            yield key, f"there is no task {name!r} here", suggestion(name, [it for it in tasks if it != task])
