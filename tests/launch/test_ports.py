"""The ports of a fleet where another program has its own."""

import socket

from pancakes.tools.launch.ports import NOT_LENT, claim_ports


def test_a_fleet_gets_ports_that_the_system_lends_to_no_dialler():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        tables = {"a": {"agent": {"listen": f"tcp://127.0.0.1:{taken.getsockname()[1]}"}}}
        claim, changes = claim_ports(tables)
    assert claim is None
    (change,) = changes["a"]
    assert change.startswith('agent.listen="tcp://127.0.0.1:') and int(change[:-1].rpartition(":")[2]) in NOT_LENT
