"""What is decided of topics and payloads without a broker."""

from __future__ import annotations

from typing import Any

import pytest
from pancakes_mqtt.packet_bodies import body_in
from pancakes_mqtt.packets import Number
from pancakes_mqtt.payloads import BadPayload, celsius_of, number_of, oddities, truth_of, value_at
from pancakes_mqtt.topics import client_id_of, fault_of_filter, fault_of_topic, filled, means

from pancakes.devices import Memory, Motion, Temperature


@pytest.mark.parametrize(
    ("filter_", "topic", "is_meant"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/b/c", False),
        ("a/b/c", "a/b", False),
        ("+/b", "a/b", True),
        ("a/+", "a/", True),
        ("a/+", "a", False),
        ("a/+/c", "a/b/c", True),
        ("a/#", "a", True),
        ("a/#", "a/b/c", True),
        ("#", "a/b", True),
        ("#", "$SYS/load", False),
        ("+/load", "$SYS/load", False),
        ("$SYS/#", "$SYS/load", True),
        ("a/b", "A/b", False),
        ("/+", "/a", True),
        ("+", "/a", False),
        ("$share/crew/jobs/#", "jobs/1", True),
        ("$share/crew/jobs/+", "other/1", False),
        ("$share/crew/#", "$SYS/load", False),
        ("$share/crew//a", "/a", True),
    ],
)
def test_a_filter_means_what_the_standard_says(filter_: str, topic: str, is_meant: bool) -> None:
    assert means(filter_, topic) is is_meant


@pytest.mark.parametrize(
    "filter_",
    [
        "a/#/b",
        "a#",
        "a/b#",
        "a+/b",
        "+a",
        "",
        "a\0",
        "$share",
        "$share/crew",
        "$share/crew/",
        "$share//a",
        "$share/c+w/a",
        "$share/crew/a#",
    ],
)
def test_what_is_no_filter_is_named(filter_: str) -> None:
    assert fault_of_filter(filter_)


@pytest.mark.parametrize("filter_", ["#", "+", "a/+/#", "+/+", "/", "ä/ö", "$share/crew/jobs/#", "$SYS/#", "$shared/a"])
def test_what_is_a_filter_is_none_the_less(filter_: str) -> None:
    assert fault_of_filter(filter_) == ""


@pytest.mark.parametrize("topic", ["", "a/+", "#", "a\0", "x" * 65536, "$share/crew/jobs", "$SYS/load"])
def test_what_is_no_topic_is_named(topic: str) -> None:
    assert fault_of_topic(topic)


def test_a_topic_is_made_of_a_template() -> None:
    assert filled("x/{agent}/{name}", {"agent": "a", "name": "b+#"}) == "x/a/b__"


@pytest.mark.parametrize(
    ("payload", "path", "value"),
    [
        (b"21.5", "", 21.5),
        (b"ON", "", "ON"),
        (b'"ON"', "", "ON"),
        (b'{"a": {"b": [1, {"c": 2}]}}', "a.b.1.c", 2),
        (b'{"a": null}', "a.b.c", None),
        (b'{"Time": 1, "X": {"T": 3}, "Y": {"H": 4}}', "*.T", 3),
        (b'{"0": 5}', "0", 5),
    ],
)
def test_a_path_leads_to_a_value(payload: bytes, path: str, value: Any) -> None:
    assert value_at(payload, path) == value


@pytest.mark.parametrize(
    ("payload", "path", "sentence"),
    [
        (b"noise", "a", "'noise' is not JSON"),
        (b"\xff\xfe", "", "is not text"),
        (b'{"a": 1}', "b", "it has no key 'b' of the path 'b', only a"),
        (b'{"a": 1}', "a.b", "the path 'a.b' leads on at 'b', but 1 is there"),
        (b'{"a": [1]}', "a.3", "the path 'a.3' wants item 3, and its list has 1"),
        (b'{"X": {"T": 3}, "Y": {"T": 4}}', "*.T", "leads to 2 values"),
        (b'{"X": {"H": 3}}', "*.T", "leads to nothing"),
        (b"[" * 100_000, "a", "is not JSON"),
    ],
)
def test_a_path_that_leads_nowhere_is_named(payload: bytes, path: str, sentence: str) -> None:
    with pytest.raises(BadPayload) as caught:
        value_at(payload, path)
    assert sentence in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("value", "number"), [(1, 1.0), ("2.5", 2.5), (" 3 ", 3.0), (None, None), ("unknown", None), ("", None)]
)
def test_numbers(value: Any, number: float | None) -> None:
    assert number_of(value) == number


@pytest.mark.parametrize("value", [True, "hot", "1_0", [1], {}, "nan", "inf", float("nan"), 10**400])
def test_what_is_no_number_is_named(value: Any) -> None:
    with pytest.raises(BadPayload):
        number_of(value)


@pytest.mark.parametrize(
    ("value", "truth"), [(True, True), ("ON", True), (1, True), ("off", False), (0, False), (None, None)]
)
def test_yes_and_no(value: Any, truth: bool | None) -> None:
    assert truth_of(value) is truth


@pytest.mark.parametrize("value", ["maybe", 2, []])
def test_what_is_neither_yes_nor_no_is_named(value: Any) -> None:
    with pytest.raises(BadPayload):
        truth_of(value)


def test_temperatures_are_celsius() -> None:
    assert [celsius_of(68.0, "F"), celsius_of(273.15, "K"), celsius_of(1.0, "C")] == [20.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("payload", "path", "value", "odd"),
    [
        (b'{"temperature":21.5,"humidity":NaN}', "temperature", 21.5, "humidity is nan"),
        (b'{"temperature":21.5,"humidity":-nan}', "temperature", 21.5, "humidity is nan"),
        (b'{"temperature":21.5,"far":[1,inf]}', "temperature", 21.5, "far.1 is inf"),
        (b'{"temperature":21.5,"far":-Infinity}', "temperature", 21.5, "far is -inf"),
        (b'{"temperature":21.5,"id":' + b"9" * 5000 + b"}", "temperature", 21.5, "id is inf"),
        (b'{"room":"K\xfcche","temperature":21.5}', "temperature", 21.5, "room is 'K\ufffdche'"),
        (b'{"room":"a nan b","n":NaN}', "room", "a nan b", "n is nan"),
        (b'{"room":"a \\" nan b","n":NaN}', "room", 'a " nan b', "n is nan"),
        (b'\xef\xbb\xbf{"temperature":21.5}', "temperature", 21.5, ""),
        (b'{"temperature":21.5}\0\0', "temperature", 21.5, ""),
        (b"21.5\0", "", 21.5, ""),
    ],
)
def test_what_can_be_read_of_a_payload_is_read(payload: bytes, path: str, value: Any, odd: str) -> None:
    assert value_at(payload, path) == value
    assert oddities(payload) == odd


@pytest.mark.parametrize("payload", [b'{"a": 1', b'{"a" 1}', b"[" * 50_000, b'{"a": "' + b'\\"' * 200_000, b"\xff\xfe"])
def test_what_cannot_be_read_at_all_is_said_in_a_sentence(payload: bytes) -> None:
    with pytest.raises(BadPayload) as caught:
        value_at(payload, "a")
    assert len(str(caught.value)) < 300
    assert oddities(payload) == ""


@pytest.mark.parametrize(
    ("kind", "payload", "body", "left_out"),
    [
        ("temperature", b'{"celsius":"18.5"}', Temperature(18.5), []),
        ("temperature", b'"18.5"', Temperature(18.5), []),
        ("motion", b'{"detected":"ON"}', Motion(True), []),
        ("motion", b'{"detected":0}', Motion(False), []),
        ("motion", b'{"detected":true,"range_m":"2"}', Motion(True, None, 2.0), []),
        ("motion", b'{"detected":true,"range_m":"unknown"}', Motion(True), []),
        ("motion", b'{"detected":true,"range_m":NaN}', Motion(True), ["range_m: nan is not a finite number"]),
        ("motion", b'{"detected":true,"range_m":"far"}', Motion(True), ["range_m: 'far' is not a number"]),
        ("memory", b'{"used_bytes":"10","total_bytes":20}', Memory(10, 20), []),
        ("mqtt.number", b'{"value":1,"unit":"1"}', Number(1.0, "1"), []),
    ],
)
def test_a_packet_is_made_of_numbers_as_drivers_read_them(kind: str, payload: bytes, body: Any, left_out: Any) -> None:
    assert body_in(payload, kind, {}) == (body, left_out)


@pytest.mark.parametrize(
    ("kind", "payload", "sentence"),
    [
        ("temperature", b'{"celsius":NaN}', "celsius: nan is not a finite number"),
        ("temperature", b'{"celsius":"unknown"}', "celsius: the device reports no value"),
        ("temperature", b'{"celsius":null}', "celsius: the device reports no value"),
        ("memory", b'{"used_bytes":"1.5","total_bytes":20}', "used_bytes"),
        ("battery", b'{"voltage_v":7.0,"level":1.2}', "<= 1.0"),
    ],
)
def test_a_packet_that_needs_what_cannot_be_read_is_none(kind: str, payload: bytes, sentence: str) -> None:
    with pytest.raises(BadPayload, match=sentence):
        body_in(payload, kind, {})


def test_words_of_ones_own_come_before_the_usual_ones() -> None:
    assert truth_of("Closed", ["closed"], []) is True
    assert truth_of(True, [], ["true"]) is False
    assert truth_of("open", ["closed"], []) is True


def test_no_two_connections_have_one_name() -> None:
    assert client_id_of("shed", "mqtt") == "pancakes-shed-mqtt"
    parts = [("a-b", "c"), ("a", "b-c"), ("a-", "b"), ("a--b", "c"), ("a", "b--c"), ("a_b", "c")]
    assert len({client_id_of(*names) for names in parts}) == len(parts)
