"""What may be a name, and how text of others is shown."""

import json
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st
from seeded import for_each

from pancakes.durable.messages import Solicit
from pancakes.durable.record import TaskId
from pancakes.errors import LocalProtocolError, PancakesError
from pancakes.kernel.stream import InformationStream
from pancakes.mesh.codec import PacketRun, RowEncoder, Unfit, head_of, messages_from_payload, packets_of, run_of
from pancakes.mesh.messages import Identity, fault_of_address
from pancakes.packet import Packet
from pancakes.util.text import fault_of_name, nearest_name, printable, printable_data, printable_line


@pytest.mark.parametrize("name", ["a", "agent1", "_x", "go-home", "ScanTarget_2", "0", "x" * 64])
def test_a_name_is_of_letters_digits_underscores_and_dashes(name: str):
    assert fault_of_name(name) == fault_of_name(name, client=True) == ""


def test_names_that_are_none_are_shown_safely():
    def check(name):
        for client in (False, True):
            fault = fault_of_name(name, client)
            assert "is not a name" in fault and fault.isascii() and fault.isprintable()

    for_each(
        [
            "",
            "-a",
            ".a",
            "a b",
            "a/b",
            "*",
            "a\n",
            "\x1b]0;owned\x07",
            "grün",
            "\u0430gent",
            "x" * 65,
            "\u202ea",
            "a:b",
        ],
        check,
    )


def test_only_a_terminal_or_a_person_has_dots_in_the_name():
    assert fault_of_name("ada.l", client=True) == ""
    assert "'ada.l' is not a name" in fault_of_name("ada.l")
    assert Identity("ada.l", "journal", role="client").hello().name == "ada.l"
    with pytest.raises(LocalProtocolError, match="'ada.l' is not a name"):
        Identity("ada.l", "journal").hello()
    with pytest.raises(LocalProtocolError, match="'all.of.them' is not a name"):
        Identity("ada", "journal", fleet="all.of.them").hello()


@given(st.text(max_size=80))
def test_what_is_suggested_is_a_name(text: str):
    near = nearest_name(text)
    assert not near or not fault_of_name(near)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:7401", "tcp://[fe80::1%eth0]:7401", "tcp://robot-3.local:1"])
def test_an_address_of_a_peer_is_one(address: str):
    assert fault_of_address(address) == ""


@pytest.mark.parametrize(
    "address", ["", "tcp://", "tcp://a b:1", "tcp://\x1b]0;x\x07:1", "127.0.0.1:7401", "tcp://ä:1"]
)
def test_what_is_no_address_is_not_taken_from_a_peer(address: str):
    assert "is no address" in fault_of_address(address)


def test_a_task_that_is_offered_under_no_name_is_not_taken():
    body = Solicit(TaskId("r2", "\x1b]0;owned\x07"), 1, "x.Task", "1", "client")
    packet = Packet("network", "migration.solicit", "r2/network/TaskMigrator", "r1", 0.0, 1, body)
    head = head_of(packet)
    (run,) = messages_from_payload(b"\x91" + run_of(head, [RowEncoder(head).encode(packet)]))
    assert isinstance(run, PacketRun)
    packets, (unfit,) = packets_of(run)
    assert packets == [] and isinstance(unfit, Unfit) and "migration.solicit" in unfit.reason


def test_no_channel_is_opened_under_what_is_no_name():
    with pytest.raises(PancakesError, match=r"'a\.b' is not a name"):
        InformationStream("a").open("a.b")


def is_hidden(character: str) -> bool:
    """Whether a terminal may do something else with it than show it."""
    return character not in "\n\t" and (
        unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp")
        or unicodedata.bidirectional(character) in ("LRE", "RLE", "PDF", "LRO", "RLO", "LRI", "RLI", "FSI", "PDI")
    )


@given(st.text(st.characters()))
def test_nothing_that_is_shown_controls_a_terminal(text: str):
    shown = printable(text)
    assert not any(map(is_hidden, shown))
    assert shown == text or any(map(is_hidden, text)) or set(text) & set("\u061c\u200e\u200f\ufeff")


def test_what_is_escaped_reads_as_python_writes_it():
    assert printable("\x1b]0;owned\x07 \x9b1m\u202e\r") == r"\x1b]0;owned\x07 \x9b1m\u202e\r"
    assert printable("naïve 日本 → ✓\ta\nb") == "naïve 日本 → ✓\ta\nb"
    assert printable_line("a\n    0.1 error b: forged") == "a\n        0.1 error b: forged"


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_json_that_is_shown_means_the_same(text: str):
    shown = printable_data(json.dumps({text: [text]}, ensure_ascii=False))
    assert json.loads(shown) == {text: [text]}
    assert not any(map(is_hidden, shown))
