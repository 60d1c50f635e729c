"""The Metrics Service: what Prometheus would read of an agent that runs."""

import http.client
import re
import socket
import urllib.request

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as openmetrics_families
from prometheus_client.parser import text_string_to_metric_families

from pancakes.control import Reschedule, Restart, Stop
from pancakes.devices import Battery, Load, Pose
from pancakes.events import Event
from pancakes.packet import NEIGHBOURS, Packet
from pancakes.task import Task, every, on
from pancakes.testing import Fleet, threaded_agent
from pancakes.tools.metrics.prometheus import MOST_REQUESTS

SERVICES = {"metrics": {"type": "metrics", "settings": {"port": 0}}}


class Tick(Task):
    """Ticks."""

    @every(hz=200)
    def tick(self, tick):
        self.publish("system", Load(0.5))


class Slow(Task):
    """Reads less than there is."""

    blocking = True

    @on("system", Pose, queue=2)
    def pose(self, packet):
        raise RuntimeError("cannot read this")


@pytest.fixture
def agent():
    with threaded_agent("a", tasks={"Tick": Tick, "Slow": Slow}, services=SERVICES) as agent:
        yield agent


def port(agent):
    return agent.component("metrics").facade.port


def scraped(agent, number=None):
    """What is served now: the value of each sample by its name and its labels but `agent`."""
    with urllib.request.urlopen(f"http://127.0.0.1:{number or port(agent)}/metrics", timeout=5) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    return {
        (sample.name, *(value for key, value in sorted(sample.labels.items()) if key != "agent")): sample.value
        for family in families
        for sample in family.samples
    }


def wait_for_a_tick(agent):
    agent.wait_until(lambda: ("pancakes_task_lateness_seconds_count", "client", "Tick", "tick") in scraped(agent))


def test_ticks_their_lateness_and_the_rate_asked_for_are_told(agent):
    agent.wait_for(Load, lambda body: agent.component("client/Tick").timers["tick"].ticks > 20)
    told = scraped(agent)
    place = ("client", "Tick", "tick")
    assert told["pancakes_task_rate_hertz", *place] == 200.0
    assert told["pancakes_task_ticks_total", *place] > 20
    assert told["pancakes_task_lateness_seconds_count", *place] > 0
    assert told["pancakes_task_lateness_seconds_bucket", "+Inf", *place] > 0
    agent.ask(Reschedule("Tick", 50.0))
    assert scraped(agent)["pancakes_task_rate_hertz", *place] == 50.0
    assert scraped(agent)["pancakes_control_changes_total", "rate_changed"] == 1.0


def test_what_waits_what_was_lost_and_what_failed_is_told(agent):
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    agent.wait_for_event("task_failed")
    agent.wait_until(lambda: agent.slot("Slow").life.state.value == "running")
    told = scraped(agent)
    assert told["pancakes_task_failures_total", "client", "Slow", "restart"] == 1.0
    assert told["pancakes_dead_letters_total",] == 1.0
    assert told["pancakes_task_starts_total", "client", "Slow"] == 2.0
    assert told["pancakes_mailbox_handled_packets_total", "system", "client", "Slow"] == 1.0
    assert ("pancakes_mailbox_waiting_packets", "system", "client", "Slow") in told
    assert ("pancakes_mailbox_dropped_packets_total", "system", "client", "Slow") in told


def test_the_battery_and_the_process_are_told(agent):
    assert not [key for key in scraped(agent) if "battery" in key[0]]
    agent.publish("system", Battery(7.4, 0.75))
    agent.wait_until(lambda: ("pancakes_battery_level_ratio",) in scraped(agent))
    told = scraped(agent)
    assert told["pancakes_battery_level_ratio",] == 0.75
    assert told["process_resident_memory_bytes",] > 1e6


def test_what_other_agents_say_of_themselves_is_not_told_as_its_own(agent):
    agent.publish("system", Battery(7.4, 0.75))
    agent.wait_until(lambda: ("pancakes_battery_level_ratio",) in scraped(agent))
    for channel, kind, body in (("system", "battery", Battery(7.4, 0.1)), ("log", "event", Event("rate_changed"))):
        agent.kernel.stream.inject(Packet(channel, kind, "b/client/T", NEIGHBOURS, 0.0, 1, body))
    agent.ask(Reschedule("Tick", 50.0))
    agent.wait_until(lambda: ("pancakes_control_changes_total", "rate_changed") in scraped(agent))
    told = scraped(agent)
    assert told["pancakes_control_changes_total", "rate_changed"] == 1.0
    assert told["pancakes_battery_level_ratio",] == 0.75


def test_what_is_written_down_is_counted(agent):
    agent.ask(Stop("Tick"))
    told = scraped(agent)
    assert told["pancakes_disk_syncs_total",] >= 1.0
    assert told["pancakes_disk_written_bytes_total",] >= 100.0


def test_they_are_for_this_machine_alone(agent):
    with socket.create_connection(("127.0.0.1", port(agent)), 20):
        pass
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", port(agent)), 20).close()


def test_a_task_that_has_ended_is_forgotten(agent):
    wait_for_a_tick(agent)
    agent.ask(Stop("Tick"))
    told = scraped(agent)
    assert ("pancakes_task_lateness_seconds_count", "client", "Tick", "tick") not in told
    assert told["pancakes_task_running", "client", "Tick"] == 0.0


def test_a_guarded_task_tells_of_its_permit_its_guardians_and_its_checkpoint():
    guarded = {"Tick": {"type": Tick, "guard": {"copies": 3, "lease_s": 2.0}}}
    with (
        threaded_agent("b"),
        threaded_agent("c"),
        threaded_agent("a", tasks=guarded, services=SERVICES, peers=("local://b", "local://c")) as agent,
    ):
        agent.wait_for_event("permit_given", task="Tick")
        agent.wait_until(lambda: ("pancakes_guard_checkpoint_age_seconds", "client", "Tick") in scraped(agent))
        told, place = scraped(agent), ("client", "Tick")
        assert 0.0 < told["pancakes_guard_permit_seconds", *place] <= 1.8
        assert told["pancakes_guard_answering_guardians", *place] >= 2.0
        assert told["pancakes_guard_wanted_guardians", *place] == 3.0
        assert 0.0 <= told["pancakes_guard_checkpoint_age_seconds", *place] < 60.0
        assert told["pancakes_guard_takeovers_total", *place] == 0.0
        service = agent.component("client")
        assert service is not None
        service.event("task_taken", task="Tick", source_agent="b", epoch=1)
        agent.wait_until(lambda: scraped(agent)["pancakes_guard_takeovers_total", *place] == 1.0)


def test_a_move_is_counted_where_the_task_was():
    with threaded_agent("a", services=SERVICES) as agent:
        account = {"task": "T", "outcome": "moved", "winner": "b"}
        service = agent.component("client")
        assert service is not None
        service.event("migration", **account, source="lost")
        service.event("migration", **account, source="a")
        agent.wait_until(lambda: ("pancakes_migrations_total", "moved") in scraped(agent))
        assert scraped(agent)["pancakes_migrations_total", "moved"] == 1.0


def test_names_follow_the_conventions_of_prometheus(agent):
    wait_for_a_tick(agent)
    with urllib.request.urlopen(f"http://127.0.0.1:{port(agent)}/metrics", timeout=5) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    ours = [family for family in families if family.name.startswith("pancakes_")]
    assert len(ours) > 15
    for family in ours:
        assert family.documentation.endswith(".")
        assert re.fullmatch(r"pancakes(_[a-z]+)+", family.name)
        assert not re.search(r"_(ms|us|milliseconds|kib|mib|percent)(_|$)", family.name)  # base units only
        if family.type == "counter":
            assert all(sample.name.endswith(("_total", "_created")) for sample in family.samples)
        else:
            assert not family.name.endswith("_total")
    names = {family.name: family.type for family in families}
    assert len(names) == len(families)
    assert names["pancakes_task_lateness_seconds"] == "histogram"


def test_a_strict_reader_of_openmetrics_understands_it_all(agent):
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    agent.wait_for_event("task_failed")
    wait_for_a_tick(agent)
    url = f"http://127.0.0.1:{port(agent)}/metrics"
    wanted = "application/openmetrics-text; version=1.0.0"
    with urllib.request.urlopen(urllib.request.Request(url, headers={"Accept": wanted}), timeout=5) as answer:
        assert answer.headers["Content-Type"].startswith(wanted)
        families = {family.name: family for family in openmetrics_families(answer.read().decode())}
    assert families["pancakes_task_failures"].type == "counter"
    buckets = [
        float(sample.labels["le"])
        for sample in families["pancakes_task_lateness_seconds"].samples
        if sample.name.endswith("_bucket") and sample.labels["task"] == "Tick"
    ]
    assert buckets == sorted(buckets)
    assert buckets[-1] == float("inf")


def test_a_restart_of_the_service_serves_anew_and_its_port_is_free_again(agent):
    first = port(agent)
    assert agent.ask(Restart("metrics")).ok
    assert scraped(agent)["pancakes_task_running", "client", "Tick"] == 1.0
    if port(agent) != first:
        with pytest.raises(OSError, match="refused"):
            scraped(agent, first)


def test_a_port_in_use_is_told_and_the_agent_runs(agent):
    taken = {"metrics": {"type": "metrics", "settings": {"port": port(agent)}, "restart": {"at_most": 1}}}
    with threaded_agent("b", services=taken) as other:
        other.wait_until(lambda: any("cannot serve at 127.0.0.1" in line for line in other.lines("error")))
        assert other.component("client") is not None


def test_links_are_told_by_peer_and_virtual_time_is_refused():
    with Fleet() as fleet:
        agent = fleet.start("a", services=SERVICES)
        fleet.run_for(30.0)
        (line,) = agent.lines("error")
        assert "serves no metrics in virtual time" in line and "given up" in line


def asked(agent, method, host, body=None):
    """The status, the header Allow and the text of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port(agent), timeout=20)
    try:
        connection.request(method, "/metrics", body=body, headers={"Host": host})
        answer = connection.getresponse()
        return answer.status, answer.getheader("Allow"), answer.read().decode()
    finally:
        connection.close()


def test_metrics_are_refused_under_a_foreign_host_name(agent):
    """A browser that a foreign name led here gets none."""
    for host in ("evil.example", "127.0.0.1.evil.example:9464", "0.0.0.0", "127.0.0.1@evil", ""):
        status, _, text = asked(agent, "GET", host)
        assert status == 421 and "127.0.0.1" in text and "pancakes_" not in text, host


def test_metrics_are_given_under_the_names_of_this_machine(agent):
    for host in ("127.0.0.1", "localhost:9464", "[::1]:1", "LOCALHOST"):
        status, _, text = asked(agent, "GET", host)
        assert status == 200 and "pancakes_" in text, host


def test_metrics_refuse_all_methods_but_get(agent):
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE", "PATCH"):
        status, allowed, text = asked(agent, method, "127.0.0.1", None if method == "TRACE" else b"x" * 1000)
        assert (status, allowed) == (405, "GET") and text.startswith(method)


def test_connections_that_ask_for_nothing_are_told_that_it_is_full_and_end(agent, capfd):
    strangers = [socket.create_connection(("127.0.0.1", port(agent)), 20) for _ in range(MOST_REQUESTS)]
    with socket.create_connection(("127.0.0.1", port(agent)), 20) as late:
        assert b"503" in (said := late.recv(1000)) and b"busy" in said
    for stranger in strangers:
        with stranger:
            assert stranger.recv(1000) == b"", "a request that does not come is not waited for"
    assert asked(agent, "GET", "localhost")[0] == 200
    assert "Traceback" not in capfd.readouterr().err


def test_a_length_of_thousands_of_digits_is_a_refusal_and_no_traceback(agent, capfd):
    connection = http.client.HTTPConnection("127.0.0.1", port(agent), timeout=20)
    connection.putrequest("POST", "/metrics")
    connection.putheader("Content-Length", "9" * 5000)
    connection.endheaders()
    connection.sock.shutdown(socket.SHUT_WR)
    assert connection.getresponse().status == 405
    connection.close()
    assert "Traceback" not in capfd.readouterr().err


def test_with_a_token_only_its_bearer_reads(tmp_path, monkeypatch):
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "run"))
    services = {"metrics": {"type": "metrics", "settings": {"port": 0, "token": True}}}

    def status(agent, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", port(agent), timeout=5)
        connection.request("GET", "/metrics", headers=headers)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, text

    with threaded_agent("a", services=services) as agent:
        path = tmp_path / "run" / f"metrics-{port(agent)}.token"
        assert path.stat().st_mode & 0o777 == 0o600
        token = path.read_text()
        assert status(agent) == (401, "send the token from the file that the log names\n")
        assert status(agent, Authorization=f"Bearer {token}x")[0] == 401
        code, text = status(agent, Authorization=f"Bearer {token}")
        assert code == 200 and "pancakes_" in text
        agent.ask(Restart("metrics"))
        agent.wait_until(lambda: not path.exists() and port(agent))
        again = tmp_path / "run" / f"metrics-{port(agent)}.token"
        assert again.read_text() != token
    assert not again.exists()
