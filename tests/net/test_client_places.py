"""Which client gives its place up where an agent has as many as it takes."""

from __future__ import annotations

import math

from seeded import for_each

from pancakes.mesh.admission import IDLE_S, THIS_MACHINE, ClientPlace, client_to_end, machine_of


def places(*rows):
    return [ClientPlace(number, machine, quiet_s) for number, (machine, quiet_s) in enumerate(rows)]


def test_the_one_that_was_quiet_longest_makes_room():
    assert client_to_end("x", places(("x", 0.0), ("x", 20.0), ("x", 30.0), ("x", 25.0))) == 2


def test_who_never_asked_for_anything_goes_first_and_of_those_the_oldest():
    assert client_to_end("x", places(("x", 1e6), ("x", math.inf), ("x", math.inf))) == 1


def test_where_all_are_in_use_the_newcomer_is_refused():
    assert client_to_end("x", places(*[("x", IDLE_S / 2)] * 5)) is None
    assert client_to_end("x", places(("x", 0.0), ("y", 0.0), ("z", 0.0))) is None


def test_a_machine_that_has_most_of_the_places_gives_one_to_another_machine():
    assert client_to_end("y", places(("x", 1.0), ("x", 2.0), ("x", 0.5), ("y", 3.0))) == 1
    assert client_to_end("y", places(("x", 1.0), ("x", 2.0), ("y", 3.0))) is None, "it would only change sides"


def test_eight_places_are_kept_for_the_agents_own_machine():
    elsewhere = [(f"10.0.0.{number}", float(number % 5)) for number in range(20)]
    there = [(THIS_MACHINE, 9.0)]
    assert client_to_end(THIS_MACHINE, places(*there, *elsewhere)) == 5
    assert client_to_end(THIS_MACHINE, places(*there * 7, *elsewhere)) == 11
    assert client_to_end(THIS_MACHINE, places(*there * 8, *elsewhere)) is None


def test_the_agents_own_machine_is_told_by_its_name():
    name = "".join(THIS_MACHINE)  # equal, and another string
    assert client_to_end(name, places((THIS_MACHINE, 9.0), ("10.0.0.1", 3.0), ("10.0.0.2", 4.0))) == 2


def test_a_client_that_was_quiet_for_ten_seconds_is_idle():
    assert client_to_end("x", places(("x", 9.99))) is None
    assert client_to_end("x", places(("x", 10.0))) == 0


def test_machine_of_an_address():
    def check(case):
        remote, machine = case
        assert machine_of(remote) == machine

    for_each(
        [
            ("tcp://127.0.0.1:40000", THIS_MACHINE),
            ("tcp://127.3.2.1:40000", THIS_MACHINE),
            ("tcp://[::1]:40000", THIS_MACHINE),
            ("tcp://[::ffff:127.0.0.1]:40000", THIS_MACHINE),
            ("tcp://[::ffff:10.0.0.7]:40000", "10.0.0.7"),
            ("tcp://10.0.0.7:1", "10.0.0.7"),
            ("memory://agent2:1", "agent2"),
            ("", ""),
        ],
        check,
    )
