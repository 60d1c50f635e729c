"""The ports of a fleet if other programs use some of them."""

import socket
import subprocess
import sys

from pancakes.tools.launch.ports import NOT_LENT, Claim, claim_ports


def test_free_ports_are_below_the_ephemeral_range():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        tables = {"a": {"agent": {"listen": f"tcp://127.0.0.1:{taken.getsockname()[1]}"}}}
        claim, changes = claim_ports(tables)
    assert claim is None
    (change,) = changes["a"]
    assert change.startswith('agent.listen="tcp://127.0.0.1:') and int(change[:-1].rpartition(":")[2]) in NOT_LENT


def test_ports_are_claimed_across_runtime_directories(tmp_path):
    """Users of one machine share its ports, but not their runtime directories."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    claims = f"""
from pancakes.tools.launch.ports import Claim
claim = Claim.to([{port}])
print(claim is not None, flush=True)
input()
"""
    other = {"PANCAKES_RUNTIME_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", claims], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=other
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        assert Claim.to([port]) is None
        process.communicate("\n")
    again = Claim.to([port])
    assert again is not None, "it ends with its process"
    again.release()
