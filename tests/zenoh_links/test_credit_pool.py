"""What peers may send before an agent has taken it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pancakes_zenoh.credit_pool import LEAST_BYTES, MOST_BYTES, TOTAL_BYTES, CreditPool


def test_a_link_where_nothing_waits_has_its_least_and_gets_it_again():
    pool = CreditPool()
    pool.opened(1)
    assert pool.on_its_way == LEAST_BYTES
    assert pool.taken(1, 100, 0) is None, "not a word for each packet"
    assert pool.taken(1, LEAST_BYTES - 100, 0) == 2 * LEAST_BYTES


def test_where_much_waits_more_is_lent_and_given_back():
    pool = CreditPool()
    pool.opened(1)
    limit = pool.taken(1, LEAST_BYTES, 10_000_000)
    assert limit == 2 * LEAST_BYTES + MOST_BYTES
    assert pool.taken(1, LEAST_BYTES + MOST_BYTES, 0) == limit + LEAST_BYTES
    assert pool.on_its_way == LEAST_BYTES


def test_more_than_was_granted_is_refused():
    pool = CreditPool()
    pool.opened(1)
    with pytest.raises(ValueError, match="4097 bytes came where 4096 were granted"):
        pool.taken(1, LEAST_BYTES + 1, 0)


@given(st.integers(1, 300), st.lists(st.tuples(st.integers(0, 299), st.integers(0, 10_000_000)), max_size=400))
def test_all_together_never_have_more_on_its_way_than_that_and_none_starves(links, steps):
    pool = CreditPool()
    limits, taken = dict.fromkeys(range(links), LEAST_BYTES), dict.fromkeys(range(links), 0)
    for link in range(links):
        pool.opened(link)
    for drawn, waiting in steps:
        link = drawn % links
        size = limits[link] - taken[link]  # a sender that uses all it has
        taken[link] += size
        limit = pool.taken(link, size, waiting)
        assert limit is not None and limit >= taken[link] + LEAST_BYTES, "one that has used all gets more"
        limits[link] = limit
        assert pool.on_its_way == sum(limits.values()) - sum(taken.values())
        assert pool.on_its_way <= max(TOTAL_BYTES, links * LEAST_BYTES + 64 * 1024)
    for link in range(links):
        pool.ended(link)
    assert pool.on_its_way == 0
