"""The search of lives sees each rule of the table that does nothing."""

from life.test_life_search import rules_that_act, unseen


def test_life_search_sees_each_rule_that_does_nothing():
    assert unseen(rules_that_act()) == []
