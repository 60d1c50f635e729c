"""Two agents that meet, and what a stranger sends."""

from pancakes.mesh.codec import RowEncoder, encode_link_message, frame, head_of, run_of
from pancakes.mesh.messages import VERSION, Hello


def pair(rig, agent, **more):
    a = agent("a", **more)
    b = agent("b", [a.address])
    rig.until(lambda: a.knows("b") and b.knows("a"))
    return a, b


def message_of(packet):
    head = head_of(packet)
    return run_of(head, [RowEncoder(head).encode(packet)])


def raw_hello(name="intruder", **more):
    values = {
        "version": VERSION,
        "fleet": "default",
        "role": "agent",
        "journal": f"journal of {name}",
        "boot": 1,
        **more,
    }
    return frame([encode_link_message(Hello(name=name, **values))])
