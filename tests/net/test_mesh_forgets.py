"""What a mesh keeps of links that have ended: nothing."""

from __future__ import annotations

import gc
import weakref

from pancakes.mesh.session import Session
from pancakes.packet import NEIGHBOURS


def test_a_session_that_has_ended_is_kept_by_nobody_whoever_was_sent_something(memory_rig):
    a = memory_rig.agent("a")
    gone: list[weakref.ref[Session]] = []
    of_others = {id(it): it for it in gc.get_objects() if isinstance(it, Session)}
    for boot in (1, 2, 3):
        b = memory_rig.agent("b", [a.address], boot=boot)
        memory_rig.until(lambda b=b: a.knows("b") and b.knows("a"))
        # Each life is sent something under a destination that is never used again.
        a.say(f"b/client/life{boot}", boot)
        a.say(NEIGHBOURS, boot)
        memory_rig.until(lambda b=b: len(b.packets) == 2)
        gone.extend(weakref.ref(it) for it in gc.get_objects() if isinstance(it, Session) and id(it) not in of_others)
        b.mesh.stop()
        memory_rig.until(lambda: not a.knows("b"))
        memory_rig.timeline.run_until(memory_rig.clock.now() + 10.0)
    gc.collect()
    assert len(gone) >= 3 and all(session() is None for session in gone)
