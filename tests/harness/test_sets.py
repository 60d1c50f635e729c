"""The limit of a test is that of its set, unless its file or the test says another."""

import pytest
from harness.limits import cpu_limit_s

pytestmark = pytest.mark.cpu_limit(25.0)


def test_limit_of_a_file_goes_before_that_of_its_set(request):
    assert cpu_limit_s(request.node) == 25.0


@pytest.mark.cpu_limit(5.0)
def test_limit_of_a_test_goes_before_that_of_its_file(request):
    assert cpu_limit_s(request.node) == 5.0
