"""What a client promises; the one that blocks and its twin for asyncio both do."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from typing import Any

import pytest
from client.counting_agents import Answer, Count, CountingAgents, Word
from client.twins import PATIENCE_S, TWINS, Connect
from seeded import for_each

from pancakes.client import AgentInfo, AsyncClient, AsyncSubscriber, Client, Subscriber, Target, TaskInfo
from pancakes.control import Describe, Reschedule, Stop
from pancakes.errors import LocalProtocolError, NoAnswerError, NoPacketError, PancakesError, UnreachableError

pytestmark = pytest.mark.usefixtures("counting")


@pytest.fixture(params=list(TWINS))
def connect(request: pytest.FixtureRequest) -> Connect:
    return TWINS[request.param]


@pytest.fixture
def said() -> list[str]:
    """What the client says meanwhile."""
    return []


@pytest.fixture
def client(connect: Connect, said: list[str]) -> Iterator[Any]:
    with connect(timeout_s=10.0, say=said.append) as client:
        yield client


# What is there ---------------------------------------------------------------------------------------------------


def test_tasks_are_rows(client: Any):
    rows = {row.address: row for row in client.tasks("a")}
    row = rows["a/client/Counting"]

    assert isinstance(row, TaskInfo)
    assert (row.agent, row.type, row.state, row.rate_hz) == ("a", "client.Counting", "running", 50.0)
    assert {row.agent for row in client.tasks()} == {"a", "b"}


def test_agents_are_rows(client: Any):
    rows = client.agents()

    assert [(row.agent, row.fleet, row.ready, row.neighbours) for row in rows] == [
        ("a", "test", True, ("b",)),
        ("b", "test", True, ("a",)),
    ]
    assert all(isinstance(row, AgentInfo) for row in rows) and "flood" in rows[0].channels


CALLS: list[Any] = [
    lambda client: client.tasks("c"),
    lambda client: client.subscribe("c/system"),
    lambda client: client.publish("c/system", Word("hello")),
    lambda client: client.configure("c/Counting", {"step": 2}),
    lambda client: client.start("c/Counting"),
    lambda client: client.stop("c/Counting"),
    lambda client: client.restart("c/Counting"),
    lambda client: client.set_rate("c/Counting", 2.0),
    lambda client: client.migrate("c/Counting"),
    lambda client: client.request("c", Describe()),
]


def test_client_refuses_an_unknown_agent(client: Any):
    def is_refused(call: Any) -> None:
        with pytest.raises(UnreachableError, match="there is no agent 'c'"):
            call(client)

    for_each(CALLS, is_refused)


def test_client_finds_late_agents_and_forgets_ended_ones(
    client: Any, counting: CountingAgents, said: list[str], monkeypatch: pytest.MonkeyPatch
):
    """An agent is found however short ago the client has looked for others."""
    with monkeypatch.context() as patch:
        patch.setattr("pancakes.client.client.LOOK_S", 600.0)
        client.tasks()
        later = counting.rig.ready("later")
        found = {row.agent for row in client.agents()}
    try:
        assert "later" in found
        with client.subscribe("later/system") as heard:
            later.process.terminate()
            later.ended()
            assert client.wait(lambda: heard.away() == ["later"], PATIENCE_S)
    finally:
        later.close()  # other tests share the agents a and b
    assert {row.agent for row in client.agents()} == {"a", "b"}
    assert said == ["later is away: waiting for it to come back"]


# What is heard ---------------------------------------------------------------------------------------------------


def test_packets_of_a_type_are_read_in_their_order(client: Any):
    with client.subscribe("a/system", Count, timeout_s=PATIENCE_S) as counts:
        heard = list(islice(counts, 5))

    first = heard[0].body.number
    assert [it.body for it in heard] == [Count(first + n) for n in range(5)]
    assert {(it.agent, it.source, it.type) for it in heard} == {("a", "a/client/Counting", "client.count")}
    assert heard[0].stamp_s < heard[-1].stamp_s <= heard[-1].packet.stamp_s


def test_a_type_is_named_by_its_name_as_well_and_a_channel_without_agent_is_that_of_all(client: Any):
    with client.subscribe("system", "client.count", timeout_s=PATIENCE_S) as counts:
        assert isinstance(next(counts).body, Count)
        assert counts.agents() == ["a", "b"] and counts.away() == []


def test_two_subscribers_to_one_channel_each_hear_what_they_wish(client: Any):
    with client.subscribe("a/system", Answer, timeout_s=PATIENCE_S) as answers:
        with client.subscribe("a/system", Count, timeout_s=PATIENCE_S) as counts:
            assert isinstance(next(counts).body, Count)
            client.publish("a/system", Word("both"))
            assert next(answers).body.text == "both"
        client.publish("a/system", Word("one"))
        assert next(answers).body.text == "one"
        assert answers.missed == 0


def test_a_function_takes_what_comes_until_it_is_closed(client: Any):
    heard: list[int] = []
    enough = threading.Event()

    def take(it: Any) -> None:
        heard.append(it.body.number)
        if len(heard) == 5:
            enough.set()

    subscriber = client.subscribe("a/system", Count, callback=take)
    assert enough.wait(PATIENCE_S)
    subscriber.close()
    so_far = list(heard)
    with client.subscribe("a/system", Count, timeout_s=PATIENCE_S) as others:
        list(islice(others, 3))
    assert heard == so_far == list(range(heard[0], heard[0] + len(heard)))


def test_a_function_that_fails_ends_with_a_sentence(client: Any, said: list[str]):
    def fail(it: Any) -> None:
        raise ValueError("no good")

    subscriber = client.subscribe("a/system", Count, callback=fail)
    assert client.wait(lambda: bool(said), PATIENCE_S)
    (sentence,) = said
    assert sentence.startswith("a/system: the callback failed, and is not called again: ValueError")
    assert "no good" in sentence and "test_client_contract.py" in sentence
    assert subscriber.failure == sentence
    with pytest.raises(PancakesError, match="no good"):
        subscriber.next()


def test_a_subscriber_that_is_too_slow_keeps_the_newest_and_is_told(client: Any, said: list[str]):
    with client.subscribe("a/flood", Count, max_waiting=5, timeout_s=PATIENCE_S) as flood:
        assert client.wait(lambda: flood.missed > 100, PATIENCE_S)
        assert client.wait(lambda: bool(said), PATIENCE_S)
        client.request("a", Reschedule("Flooding", 0.0))
        client.request("a", Describe())  # whose answer comes after all that was published before
        list(flood.during(0.5))
        before = flood.missed
        client.request("a", Reschedule("Flooding", 1000.0 / 97))
        assert client.wait(lambda: flood.missed > before + 100, PATIENCE_S)
        client.request("a", Reschedule("Flooding", 0.0))
        client.request("a", Describe())
        assert [it.body.number for it in flood.during(0.5)] == [95, 96, 97, 98, 99]
    client.request("a", Reschedule("Flooding", 10.0))
    assert said == [
        "a/flood: this program is too slow, so the oldest packets are dropped: ask for fewer types, or read faster"
    ]


def test_where_nothing_comes_in_time_a_sentence_says_so(client: Any):
    with client.subscribe("b/system", Count, timeout_s=0.2) as counts:
        with pytest.raises(TimeoutError, match=r"nothing came on b/system within 0\.2 s"):
            next(counts)
        with pytest.raises(NoPacketError, match=r"nothing came on b/system within 0\.1 s"):
            counts.next(0.1)
        assert counts.take(0.1) is None
        assert list(counts.during(0.1)) == []


def test_one_that_is_closed_ends_its_loop_and_has_no_next(client: Any):
    with client.subscribe("a/system", Count, timeout_s=PATIENCE_S) as counts:
        next(counts)
    assert counts.closed and list(counts) == []
    with pytest.raises(PancakesError, match="a/system is closed: subscribe again"):
        counts.next()


def test_an_agent_that_comes_back_is_heard_again(client: Any, counting: CountingAgents, said: list[str]):
    tasks = '[task.Back]\ntype = "client.Counting"\n'
    first = counting.rig.ready("back", tasks)
    with client.subscribe("back/system", Count, timeout_s=PATIENCE_S) as counts:
        next(counts)
        first.process.terminate()
        first.ended()
        assert client.wait(lambda: counts.away() == ["back"], PATIENCE_S)
        with pytest.raises(NoPacketError, match=r"within 0\.1 s: back is away"):
            while True:
                counts.next(0.1)
        second = counting.rig.ready("back", tasks)
        assert next(counts).agent == "back"
        assert client.wait(lambda: len(said) == 2, PATIENCE_S)
    assert said == ["back is away: waiting for it to come back", "back is here"]
    second.process.terminate()
    second.ended()


def test_events_are_rows_and_sentences(client: Any):
    with client.events("a", kinds=("rate_changed",), timeout_s=PATIENCE_S) as events:
        reply = client.request("a", Reschedule("Answering", 1.0))
        assert not reply.ok  # it has no timer, so there is no event
        client.request("a", Reschedule("Counting", 40.0))
        client.request("a", Reschedule("Counting", 50.0))
        rows = list(islice(events, 2))
    assert [row.fields["rate_hz"] for row in rows] == [40.0, 50.0]
    assert {(row.agent, row.kind, row.fields["task"]) for row in rows} == {("a", "rate_changed", "Counting")}
    assert str(rows[0]).startswith("a runs Counting at 40 Hz, asked by ")


def test_lines_for_people_are_events_too(client: Any):
    with client.events("a", kinds="line", timeout_s=PATIENCE_S) as lines:
        client.publish("a/system", Word("hello"))
        row = next(row for row in lines if row.source == "a/client/Answering")
    assert (row.kind, row.fields["level"], row.fields["text"]) == ("line", "info", "hello was said")
    assert str(row) == "a: hello was said"


WRONG: Any = 3
WRONG_WORD, WRONG_STOP = Word(WRONG), Stop(WRONG)


NONSENSE: list[tuple[Any, str]] = [
    (lambda client: client.subscribe("a/sistem"), "has no channel 'sistem'"),
    (lambda client: client.subscribe("a/system/x/y"), "'a/system/x/y' names no channel: write it as AGENT/CHANNEL"),
    (lambda client: client.subscribe("a/system", dict), "builtins.dict is no packet type"),
    (lambda client: client.subscribe("a/system", agents=("b",)), "'a/system' names its agent"),
    (lambda client: client.subscribe("a/system", max_waiting=0), "max_waiting is a number of packets from 1, not 0"),
    (lambda client: client.subscribe("a/system", timeout_s=-1.0), r"a number of seconds above 0, not -1\.0"),
    (lambda client: client.tasks(timeout_s=float("nan")), "a number of seconds above 0, not nan"),
    (lambda client: client.publish("system", Word("x")), "'system' names no channel of an agent"),
    (lambda client: client.publish("a/sistem", Word("x")), "a has no channel 'sistem', did you mean 'system'"),
    (lambda client: client.publish("a/system", {"text": "x"}), "builtins.dict is no packet type"),
    (lambda client: client.publish("a/system", WRONG_WORD), "Word cannot be sent: .*Expected `str`, got `int`"),
    (lambda client: client.request("a", WRONG_STOP), "Stop cannot be sent: .*Expected `str`, got `int`"),
    (lambda client: client.publish("a/system", Word("x"), to="a/b/c/d"), "'a/b/c/d' is not a service or task of a"),
    (lambda client: client.publish("a/sysctrl", Stop("Counting")), "Stop is a control packet.*client.request"),
    (lambda client: client.stop("a/Countink"), "no task or service 'Countink', did you mean 'Counting'"),
    (lambda client: client.start("a/Counting"), "is running already"),
    (lambda client: client.set_rate("a/Counting", -1.0), "rate"),
    (lambda client: client.set_rate("a/Counting", 1.0, timer="tock"), "no timer 'tock'"),
    (lambda client: client.configure("Counting", {}), "'Counting' names no task: write it as AGENT/TASK"),
    (lambda client: client.configure("a/Countink", {}), "no task or service 'Countink', did you mean 'Counting'"),
    (lambda client: client.configure("a/Counting", {"stepp": 2}), "stepp"),
    (lambda client: client.configure("a/Counting", {"step": 0}), "step"),
    (lambda client: client.settings("a/client"), "a/client is a service, not a task"),
    (lambda client: client.migrate("a/Counting", "c"), "c"),
]


def test_client_refuses_nonsense(client: Any):
    def refuses(case: tuple[Any, str]) -> None:
        call, sentence = case
        with pytest.raises(PancakesError, match=sentence) as caught:
            call(client)
        assert "\n" not in str(caught.value)

    for_each(NONSENSE, refuses)


# What is done ----------------------------------------------------------------------------------------------------


def test_what_is_published_comes_in_the_mission_time_of_its_agent(client: Any):
    with client.subscribe("a/system", Answer, timeout_s=PATIENCE_S) as answers:
        before_s = client.agents("a")[0].mission_s
        client.publish("a/system", Word("hello"))
        client.publish("a/system", Word("you"), to="client/Answering")
        client.publish("a/system", Word("nobody's"), to="client/Counting")
        client.publish("a/system", Word("two"), to="a/client/Answering")
        client.settle()
        after_s = client.agents("a")[0].mission_s
        heard = [it.body for it in islice(answers, 3)]
    assert [it.text for it in heard] == ["hello", "you", "two"]
    assert all(before_s <= it.stamp_s <= after_s for it in heard)


def test_a_loop_ends_where_the_client_is_closed_while_it_waits(connect: Connect):
    ended: list[object] = []

    def read(subscriber: Any) -> None:
        try:
            ended.append(list(subscriber))
        except PancakesError as error:
            ended.append(error)

    with connect(timeout_s=10.0) as client:
        threads = [
            threading.Thread(target=read, args=(client.subscribe("a/log", "nothing.Such"),), daemon=True)
            for _ in range(3)
        ]
        for thread in threads:
            thread.start()
        client.settings("a/Counting")
    for thread in threads:
        thread.join(PATIENCE_S)
    assert ended == [[], [], []]


def test_at_the_end_of_with_all_has_arrived(connect: Connect):
    with Client(timeout_s=10.0) as listener, listener.subscribe("a/system", Answer, timeout_s=PATIENCE_S) as answers:
        with connect() as client:
            for number in range(20):
                client.publish("a/system", Word(str(number)))
        assert [it.body.text for it in islice(answers, 20)] == [str(number) for number in range(20)]


def test_where_it_is_not_known_whether_all_has_arrived_the_end_of_with_says_so(
    connect: Connect, counting: CountingAgents, said: list[str]
):
    with ExitStack() as stack:
        with connect(timeout_s=0.5, say=said.append) as client:
            client.publish("b/system", Word("perhaps"), timeout_s=10.0)
            stack.enter_context(counting.frozen(counting.b))
    (sentence,) = said
    assert sentence == (
        "it is not known whether the last published packets have arrived: b did not answer: nothing came within 0.5 s"
    )


def test_client_stops_starts_restarts_and_sets_rates(client: Any):
    def row() -> TaskInfo:
        (found,) = [row for row in client.tasks("a") if row.task == "Counting"]
        return found

    assert client.stop("a/Counting", dry_run=True).ok and row().state == "running"
    assert client.set_rate(row(), 20.0).result["before_hz"] == 50.0
    assert row().rate_hz == 20.0
    assert client.stop("a/Counting").ok and row().state == "stopped"
    assert client.start(row(), {"step": 4}).ok and client.settings("a/Counting") == {"step": 4}
    assert client.restart("a/client/Counting", keep_state=False).ok and client.settings("a/Counting") == {"step": 1}
    assert row().rate_hz == 50.0


def test_client_keeps_to_one_fleet(connect: Connect):
    with connect(fleet="test", timeout_s=10.0) as client:
        assert {row.agent for row in client.agents()} == {"a", "b"}
    with pytest.raises(PancakesError, match="a client keeps to one fleet, and was given 'east' and 'west'"):
        with connect(Target(fleet="east"), fleet="west", timeout_s=1.0) as client:
            client.agents()


def test_settings_are_read_and_changed(client: Any):
    assert client.settings("a/Counting") == {"step": 1}
    assert client.configure("a/client/Counting", {"step": 3}, dry_run=True).ok
    assert client.settings("a/Counting") == {"step": 1}
    (row,) = [row for row in client.tasks("a") if row.task == "Counting"]
    reply = client.configure(row, {"step": 2})
    assert reply.ok and reply.number > 0
    with client.subscribe("a/system", Count, timeout_s=PATIENCE_S) as counts:
        one, other = islice(counts, 2)
    assert other.body.number - one.body.number == 2
    client.configure("a/Counting", {"step": 1})


def test_a_task_moves_with_its_state_and_the_account_says_so(client: Any):
    bids = client.migrate("a/Counting", dry_run=True)
    assert (bids.outcome, bids.winner, [line.peer for line in bids.lines]) == ("dry run", "b", ["b"])
    with client.subscribe("system", Count, timeout_s=PATIENCE_S) as counts:
        before = next(counts).body.number
        moved = client.migrate("a/Counting", "b")
        assert (moved.task_id, moved.source, moved.outcome, moved.winner) == ("a/Counting", "a", "moved", "b")
        on_b = next(it for it in counts if it.agent == "b")
        assert on_b.body.number > before
    assert client.migrate("b/Counting", "a").outcome == "moved"


def test_an_agent_that_does_not_answer_in_time_is_a_sentence(client: Any, counting: CountingAgents):
    client.request("b", Describe())
    with (
        counting.frozen(counting.b),
        pytest.raises(NoAnswerError, match=r"b did not answer: nothing came within 0\.2 s"),
    ):
        client.request("b", Describe(), timeout_s=0.2)
    assert client.request("b", Describe()).ok


def test_what_cannot_travel_is_not_asked_and_that_is_no_missing_answer(client: Any):
    for attempt, why in (
        (lambda: client.configure("a/Counting", {"step": object()}), "body.settings.step is of the type object"),
        (lambda: client.configure("a/Counting", {1: 2}), "keys must be strings"),
        (lambda: client.request("a", 5), "builtins.int is no packet type"),
        (lambda: client.request_all(5), "builtins.int is no packet type"),
    ):
        with pytest.raises(LocalProtocolError, match=why):
            attempt()
    assert client.request("a", Describe()).ok


def test_one_name_of_an_agent_is_one_agent(client: Any):
    with pytest.raises(UnreachableError, match="there is no agent 'ab'"):
        client.subscribe("system", agents="ab").next(0.1)


def test_an_agent_that_is_silent_is_said_beside_the_rows_of_the_others(
    client: Any, counting: CountingAgents, said: list[str]
):
    client.agents()
    with counting.frozen(counting.b):
        assert {row.agent for row in client.tasks(timeout_s=0.5)} == {"a"}
    (sentence,) = said
    assert sentence.startswith("b (") and "did not answer: nothing came within 0.5 s" in sentence


# The client itself -----------------------------------------------------------------------------------------------


def test_one_that_is_closed_says_so(connect: Connect):
    with connect() as client:
        client.tasks()
        client.close()
        with pytest.raises(PancakesError, match="the client is closed: make a new one"):
            client.tasks()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"at": "somewhere:"}, "somewhere"),
        ({"timeout_s": 0.0}, r"a time limit is a number of seconds above 0, not 0\.0"),
        ({"timeout_s": "3"}, "a time limit is a number of seconds above 0, not '3'"),
    ],
)
def test_client_refuses_bad_arguments(connect: Connect, arguments: dict[str, Any], sentence: str):
    with pytest.raises(PancakesError, match=sentence), connect(**arguments):
        pass


def test_client_refuses_an_address_without_agent(connect: Connect):
    with connect("127.0.0.1:1", timeout_s=2.0) as client, pytest.raises(UnreachableError, match="127.0.0.1:1"):
        client.tasks()


def names_of(cls: type) -> set[str]:
    return {name for name in dir(cls) if not name.startswith("_")}


BLOCKING_ONLY = {"is_own", "now", "use_fleet", "waiting"}
"""Methods of `Client` that wait for nothing, and that no program for asyncio has needed."""
INTERNAL = {"call_for_each", "fail", "keep_alive", "nothing_came", "on_news"}


@pytest.mark.parametrize(
    ("one", "other", "without"), [(Client, AsyncClient, BLOCKING_ONLY), (Subscriber, AsyncSubscriber, INTERNAL)]
)
def test_client_twins_have_the_same_names(one: type, other: type, without: set[str]):
    assert names_of(one) - without == names_of(other)
