"""One test for many seeds: it runs them all, and names those that fail."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any


def for_each(cases: Iterable[Any], check: Callable[[Any], object]) -> None:
    """Call `check` with each case.

    Args:
        cases: seeds mostly; their text names them.
        check: raises if a case fails.

    Raises:
        ExceptionGroup: at least one case failed. It has the failures of all cases, and names these cases.
    """
    failures: list[Exception] = []
    failed: list[str] = []
    count = 0
    for case in cases:
        count += 1
        try:
            check(case)
        except Exception as error:
            error.add_note(f"case {case}")
            failures.append(error)
            failed.append(str(case)[:200])
    if failures:
        raise ExceptionGroup(f"{len(failures)} of {count} cases fail: {', '.join(failed)}", failures)
