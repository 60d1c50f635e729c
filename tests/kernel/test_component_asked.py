"""What an actor is asked by a reference of pykka, and what the asker hears where the actor fails or ends."""

import pytest
from kernel.virtual_rig import Diary
from pykka import ActorDeadError


def test_the_asker_of_an_actor_that_has_stopped_is_told(virtual):
    diary = virtual.spawn(Diary, "a/client/Diary")
    waiting = diary.actor_ref.ask("hello", block=False)
    diary.stop()
    late = diary.actor_ref.ask("are you there?", block=False)
    virtual.settle()
    with pytest.raises(TypeError, match="takes packets, not 'hello'"):
        waiting.get(timeout=0)
    with pytest.raises(ActorDeadError):
        late.get(timeout=0)
    for ask in (diary.actor_ref.ask, diary.actor_ref.tell):
        with pytest.raises(ActorDeadError):
            ask("hello")


def test_a_question_that_crosses_the_end_of_an_actor_is_answered(virtual):
    """`ask` looks whether the actor is alive, and puts its question in: the actor may end between the two."""
    diary = virtual.spawn(Diary, "a/client/Diary")
    ref, inbox = diary.actor_ref, diary.actor_inbox
    questions = []

    class Crossing:
        def put(self, envelope):
            ref.actor_inbox = inbox
            diary.stop()
            virtual.settle()
            inbox.put(envelope)
            questions.append(envelope)

    ref.actor_inbox = Crossing()
    with pytest.raises(ActorDeadError):
        ref.ask("too late", block=False).get(timeout=0)


@pytest.mark.parametrize("error", [ValueError("asked badly"), SystemExit(4)])
def test_the_asker_of_what_fails_gets_the_error(virtual, error):
    class Failing(Diary):
        def fail(self):
            raise error

    failing = virtual.spawn(Failing, "a/client/Failing")
    question = failing.actor_ref.proxy().fail()
    virtual.settle()
    with pytest.raises(type(error)):
        question.get(timeout=0)
    # As in pykka: an error goes to the asker, and the actor lives; what would end the process ends this actor alone.
    assert failing.actor_ref.is_alive() == isinstance(error, Exception)
