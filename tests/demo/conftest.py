"""Lets pytest explain the assertions of the checks that several files share."""

import pytest

pytest.register_assert_rewrite("demo.flight_checks", "demo.flights")
