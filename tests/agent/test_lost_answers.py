"""An agent whose answer cannot be sent goes on."""

from pancakes.control import Describe
from pancakes.mesh.session import PeerBusy
from pancakes.task import Task
from pancakes.testing import Fleet


def test_an_asker_that_does_not_listen_ends_neither_the_root_nor_a_service(monkeypatch):
    with Fleet(seed=1) as fleet:
        a = fleet.start("a", tasks={"Task": Task})
        b = fleet.start("b")
        fleet.connect()
        send = a.agent.mesh.send

        def busy(packet, retry=False):
            if packet.type == "reply":
                raise PeerBusy("b is too slow")
            return send(packet, retry)

        with monkeypatch.context() as patch:
            patch.setattr(a.agent.mesh, "send", busy)
            for target in ("", "Task", "client", "nobody"):
                b.publish("sysctrl", Describe(target), to="a")
            fleet.run_for(1.0)
        assert any("the answer to b/test/Probe was lost" in line for line in a.lines("warning"))
        assert not a.events("service_failed")
        assert b.ask(Describe(), to="a").ok
