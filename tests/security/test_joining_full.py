"""The race of test_joining.py, more often."""

from __future__ import annotations

from security.test_joining import check_one_joins


def test_joining_many_at_once_with_one_code_one_joins_full():
    check_one_joins(15)
