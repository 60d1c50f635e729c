"""Decide what happened to a task in trouble, what to do about it, and what that loses.

Pure: findings in, a diagnosis out. It knows what agents report, and nothing of how they agree with each other.

A proposal is the mildest act that helps: it waits if the trouble ends by itself, has the guardians take over if they
can, and only then goes by the word of a person. An act that makes an owner (`--here`) and an act that gives up a state
(`--not-here`) are never one, except between two owners, where a person chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final, Literal

import msgspec

from pancakes.durable.record import DISK_LOST, MOVED, OLD_COPY, WAITS

Choice = Literal["", "here", "not here"]
"""What a person wants: the proposal, the task on the agent that the name begins with, or not there."""
Act = Literal["", "start", "adopt", "resume", "revive", "begin", "keep", "leave", "take", "obey"]
"""What is done: nothing; start it again; run it from what its agent has; let it go on without its guardians; run it
from the newest checkpoint; begin from scratch; keep one of two copies; leave it elsewhere; have its guardians take it
over; have actuators obey its present owner."""
Trouble = Literal[
    "",
    "two owners",
    "in doubt",
    "lost disk",
    "restored backup",
    "copied disk",
    "damaged record",
    "guardians gone",
    "silent owner",
    "lost agent",
    "given up",
    "cannot start",
    "waits",
    "disobeyed",
    "unknown",
]
"""What happened, in two words; empty: the task is in order."""

ACTING: Final = ("running", "starting", "restarting", "stuck")
"""The states of a task that runs, or is about to."""
DISPUTED: Final = "disputed"
FORGOTTEN: Final = "forgotten"
FAILED: Final = "failed"


class Copy(msgspec.Struct, frozen=True, kw_only=True):
    """What one agent reports about the task.

    Attributes:
        agent: the agent.
        service: the service of the task; empty if the agent does not list the task.
        state: its state, such as `running`; empty if the agent does not list it.
        rest: why it does not run, in a word, as `pancakes task list` shows it.
        reason: the same as a sentence.
        waits: whether it starts by itself once it can.
        epoch: the number of its epoch; None: unknown.
        permit: whether its guardians let it act; always so if it is not guarded.
        copied: whether the agent's disk is a copy, so that its guardians decide.
        in_doubt: whether a migration to or from `other` was cut off, and the agent keeps the task's snapshot.
        other: the other owner, or the other agent of a migration that is in doubt; empty: none is known.
        may_run: whether the agent would run it on a person's word.
        may_leave: whether the agent would give up on a person's word what it has of the task.
        linked: the agents that this one is connected to.
    """

    agent: str
    service: str = "client"
    state: str = ""
    rest: str = ""
    reason: str = ""
    waits: bool = False
    epoch: int | None = None
    permit: bool = True
    copied: bool = False
    in_doubt: bool = False
    other: str = ""
    may_run: bool = False
    may_leave: bool = False
    linked: tuple[str, ...] = ()

    @property
    def acts(self) -> bool:
        """Whether the task runs there, or is about to."""
        return self.state in ACTING and self.permit and not self.copied

    @property
    def gave_to(self) -> str:
        """The agent that it was given to; empty: none."""
        return self.rest.removeprefix(MOVED) if self.rest.startswith(MOVED) else ""

    @property
    def is_stopped(self) -> bool:
        """Whether only a stop keeps it from running there."""
        return self.state == "stopped" and self.rest in ("", "stopped") and not self.waits

    @property
    def is_paused(self) -> bool:
        """Whether only its guardians keep it from acting."""
        return self.copied or (self.state in ACTING and not self.permit)


class Checkpoint(msgspec.Struct, frozen=True):
    """A checkpoint of the task, as an agent holds it.

    Attributes:
        agent: the agent.
        epoch: the number of its epoch, and the agent that minted it.
        no: its sequence number under that epoch.
        story: which one it is, how old it is, and which agent holds it, as a clause.
        guardians: the guardians of the task as this agent knows them, one or two groups; empty: a migration left it.
        running: whether the task should run.
    """

    agent: str
    epoch: tuple[int, str]
    no: int
    story: str
    guardians: tuple[tuple[str, ...], ...] = ()
    running: bool = True


class Guard(msgspec.Struct, frozen=True):
    """What a guardian reports about the task.

    Attributes:
        agent: the guardian.
        owner: the agent whose task it guards.
        epoch: the number of the task's epoch.
        lease_left_s: for how long the owner's lease still runs, in seconds; None: none runs.
        silent_s: how long ago it heard the owner, in seconds.
        running: whether the task should run.
    """

    agent: str
    owner: str
    epoch: int
    lease_left_s: float | None
    silent_s: float
    running: bool = True

    @property
    def hears_owner(self) -> bool:
        """Whether the owner lives: a living owner renews its lease long before the end."""
        return self.lease_left_s is not None and self.silent_s <= self.lease_left_s


class Actuator(msgspec.Struct, frozen=True):
    """An actuator that the task has commanded.

    Attributes:
        agent: the agent of the actuator.
        target: the actuator, as `service/device`.
        seen: the highest epoch that it has seen of the task, `NUMBER@AGENT`.
        brought_by: the agent that brought that one.
        owner: the task's present owner; empty: unknown.
        owner_has: its epoch; empty: unknown.
        warned: whether it has refused a command of the task lately.
    """

    agent: str
    target: str
    seen: str
    brought_by: str
    owner: str
    owner_has: str
    warned: bool = False

    @property
    def refuses(self) -> bool:
        """Whether it refuses the task's present owner; a lower epoch that is not refused is raised by a command."""
        if not self.owner_has or self.seen == self.owner_has:
            return False
        return self.warned or _epoch(self.seen) > _epoch(self.owner_has)


class TakeOver(msgspec.Struct, frozen=True):
    """What the guardians answer to the question who would take the task over.

    Attributes:
        asked: the guardian that was asked.
        taker: the agent that would take it; empty: none would.
        story: the checkpoint, and how long the owner has been silent, as a clause.
        refusal: why it would not be taken over.
    """

    asked: str
    taker: str = ""
    story: str = ""
    refusal: str = ""


class Findings(msgspec.Struct, frozen=True, kw_only=True):
    """All that the agents that answer report about one task.

    Attributes:
        task_id: the task, as `birthplace/name`.
        asked: the agent that the person named.
        answers: the agents that answer.
        silent: sentences about agents that do not.
        copies: what agents have of the task.
        checkpoints: its checkpoints.
        guards: what its guardians report.
        actuators: those that it has commanded.
        take_over: what its guardians would do; None: they were not asked.
        able: the agent that would run it from the newest checkpoint, or as the configuration says; empty: none.
        unable: why none would, as a sentence.
        configuration: the file that says how the task begins from scratch; empty: none was given.
        service: the service that the person named; empty: none.
        hint: what may be meant instead, as a clause with a comma before it; empty: nothing.
    """

    task_id: str
    asked: str
    answers: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()
    copies: tuple[Copy, ...] = ()
    checkpoints: tuple[Checkpoint, ...] = ()
    guards: tuple[Guard, ...] = ()
    actuators: tuple[Actuator, ...] = ()
    take_over: TakeOver | None = None
    able: str = ""
    unable: str = ""
    configuration: str = ""
    service: str = ""
    hint: str = ""

    @property
    def name(self) -> str:
        """The name of the task, without its birthplace."""
        return self.task_id.partition("/")[2]

    def copy(self, agent: str) -> Copy | None:
        """Return what an agent has of the task; None: nothing."""
        return next((copy for copy in self.copies if copy.agent == agent), None)


class Proposal(msgspec.Struct, frozen=True, kw_only=True):
    """What could be done.

    Attributes:
        act: what it is; empty: the command does nothing, and `text` says what a person can do.
        agent: the agent that it is done on.
        others: the agents whose copies are given up, for `keep`; the actuators (`agent/service/device`), for `obey`.
        text: what is done, as an imperative clause without a full stop.
        lost: what is lost, as a clause; empty: nothing.
        only_if: what must be true, because otherwise two copies run; empty: nothing can go wrong.
        command: the command line that does just this.
        fine: whether nothing needs to be done.
    """

    act: Act = ""
    agent: str = ""
    others: tuple[str, ...] = ()
    text: str = ""
    lost: str = ""
    only_if: str = ""
    command: str = ""
    fine: bool = False


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True):
    """What happened to a task, and what to do.

    Attributes:
        task_id: the task, as `birthplace/name`.
        trouble: what happened, in two words; empty: it is in order.
        what: the same in sentences.
        proposal: the mildest thing that helps, or what was chosen.
        choices: what could be done instead.
    """

    task_id: str
    trouble: Trouble
    what: str
    proposal: Proposal
    choices: tuple[Proposal, ...] = ()


def diagnose(found: Findings, choice: Choice = "") -> Diagnosis:
    """Return what happened to a task, and what to do.

    Args:
        found: what the agents report.
        choice: what the person wants; empty: the proposal.
    """
    told = next(it for case in _CASES if (it := case(found)) is not None)
    if not choice:
        return told
    wanted = _here(found) if choice == "here" else _not_here(found)
    return msgspec.structs.replace(told, proposal=wanted, choices=())


def newest(checkpoints: Iterable[Checkpoint]) -> Checkpoint:
    """Return the newest of some checkpoints."""
    return max(checkpoints, key=lambda it: (it.epoch, it.no, it.agent))


def _quorum(found: Findings) -> bool:
    """Return whether more than half of the guardians answer, as the one with the newest checkpoint knows them."""
    guarded = [it for it in found.checkpoints if it.guardians]
    if not guarded:
        return False
    holders = {it.agent for it in guarded}
    return all(2 * len(holders.intersection(group)) > len(group) for group in newest(guarded).guardians)


def _epoch(text: str) -> tuple[int, str]:
    number, _, minter = text.partition("@")
    return int(number), minter


def _names(names: Sequence[str]) -> str:
    return " and ".join((", ".join(names[:-1]), names[-1])) if len(names) > 1 else "".join(names)


def _command(found: Findings, agent: str = "", option: str = "") -> str:
    return " ".join(filter(None, ("pancakes task recover", f"{agent or found.asked}/{found.name}", option)))


def _away(found: Findings) -> str:
    """Return what to beware of if a copy may be on an agent that does not answer."""
    return f"no agent that is off or cut off from here still has {found.task_id}"


def _stays_away(agent: str) -> str:
    """Return what to beware of if the task may be on the disk of one agent."""
    return f"{agent} is off, and never comes back with its present disk (set it up again with an empty one)"


# What a person may choose ----------------------------------------------------------------------------------------


def _keep(found: Findings, keeper: Copy, others: Sequence[Copy], option: str = "") -> Proposal:
    """Keep one of two copies."""
    names = tuple(copy.agent for copy in others)
    text = f"keep the copy on {keeper.agent}, with its state, and end the copy on {_names(names)}"
    command = _command(found, keeper.agent, option)
    return Proposal(
        act="keep",
        agent=keeper.agent,
        others=names,
        text=text,
        lost=f"the state of the copy on {_names(names)}",
        command=command,
    )


def _keep_alone(found: Findings, copy: Copy, option: str = "") -> Proposal:
    """Keep a copy whose other owner does not answer."""
    other = copy.other or "the other owner"
    return Proposal(
        act="keep",
        agent=copy.agent,
        text=f"let the copy on {copy.agent} go on; the copy on {other} is paused when {other} is back",
        lost=f"what {other} did since the two copies parted, once you end its copy",
        only_if=f"{other} is off, or gone for good",
        command=_command(found, copy.agent, option),
    )


def _adopt(found: Findings, copy: Copy, option: str = "") -> Proposal:
    """Run the task from what an agent has of it."""
    agent = copy.agent
    only_if = _away(found)
    if copy.in_doubt:
        text = f"run it on {agent}, from the state that it had when the migration was cut off"
        lost = f"what it did on {copy.other} since, if it had begun there"
        only_if = _stays_away(copy.other)
    elif copy.rest == OLD_COPY:
        text = f"let it go on on {agent}, from the backup"
        lost = "what it did since the backup was made"
    elif copy.rest in (DISK_LOST, FORGOTTEN) or copy.gave_to:
        text = f"begin it on {agent} from scratch, as its configuration says"
        lost = "all of its former state"
        gone = _last_given_to(found)
        if gone and gone not in found.answers:
            only_if = _stays_away(gone)
    else:
        text = f"run it on {agent}, from what can be read of its record, or else from scratch"
        lost = "what cannot be read of its record"
    return Proposal(
        act="adopt", agent=agent, text=text, lost=lost, only_if=only_if, command=_command(found, agent, option)
    )


def _resume(found: Findings, copy: Copy, option: str = "") -> Proposal:
    """Let a paused guarded task go on without its guardians."""
    others = sorted({name for it in found.checkpoints for group in it.guardians for name in group} - {copy.agent})
    gone = [name for name in others if name not in {it.agent for it in found.guards}]
    return Proposal(
        act="resume",
        agent=copy.agent,
        text=f"let it go on on {copy.agent} as it is; only {copy.agent} guards it until other agents agree to",
        lost=f"what it did elsewhere since the disk of {copy.agent} was copied" if copy.copied else "",
        only_if=f"{_names(gone) or 'the other guardians'} {'are' if len(gone) != 1 else 'is'} off, or gone for good",
        command=_command(found, copy.agent, option),
    )


def _revive(found: Findings, option: str = "") -> Proposal:
    """Run the task on the agent that is able to, from the newest checkpoint or from scratch."""
    if found.configuration:
        act: Act = "begin"
        text = f"begin it on {found.able} from scratch, as {found.configuration} says"
        lost = "all of its state, and the effect of all packets that it acknowledged"
    else:
        act = "revive"
        text = f"run it on {found.able}, from {newest(found.checkpoints).story}"
        lost = "what it did since that checkpoint, and the effect of packets that it acknowledged since"
    return Proposal(
        act=act,
        agent=found.able,
        text=text,
        lost=lost,
        only_if=_away(found),
        command=_command(found, found.able, option),
    )


def _link(copy: Copy) -> Proposal:
    """Have a paused owner hear its guardians again, which answer."""
    return _nothing(
        f"link {copy.agent} to its guardians: more than half of them answer this command. It goes on by itself then"
    )


def _start(found: Findings, copy: Copy, option: str = "") -> Proposal:
    text = f"start it again on {copy.agent}, with the state that it has"
    return Proposal(act="start", agent=copy.agent, text=text, command=_command(found, copy.agent, option))


def _at_once(found: Findings, copy: Copy) -> Proposal:
    """Start a task that waits until other agents have said what they know of it."""
    return Proposal(
        act="start",
        agent=copy.agent,
        text=f"start it on {copy.agent} at once",
        lost="all of its former state, if it has run elsewhere",
        only_if=_away(found),
        command=_command(found, copy.agent, "--here"),
    )


def _leave(found: Findings, copy: Copy, runs_on: str = "", option: str = "--not-here") -> Proposal:
    """Have an agent give up what it has of the task."""
    text = f"have {copy.agent} give up what it has of it, and not start it by itself any more"
    lost = f"what {copy.agent} has of it" + ("" if runs_on else ": if it runs nowhere else, it is gone")
    if runs_on:
        text = f"leave it on {runs_on}, and have {copy.agent} not start it by itself any more"
        lost = "" if copy.rest == DISK_LOST else f"the state that {copy.agent} has of it, which {runs_on} does not need"
    command = _command(found, copy.agent, option)
    return Proposal(act="leave", agent=copy.agent, text=text, lost=lost, command=command)


def _nothing(text: str) -> Proposal:
    return Proposal(text=text)


def _fine(text: str = "leave it as it is") -> Proposal:
    return Proposal(text=text, fine=True)


def _here(found: Findings) -> Proposal:
    """Return how the task comes to run on the agent that the person named, or why not."""
    asked, task, here = found.asked, found.task_id, found.copy(found.asked)
    if asked not in found.answers:
        return _nothing(
            f"name an agent that should run it, because {asked} does not answer. These do: {_names(found.answers)}"
        )
    disputed = [copy for copy in found.copies if copy.rest == DISPUTED]
    acting = [copy for copy in found.copies if copy.acts]
    owners = {copy.agent: copy for copy in (*disputed, *acting)}
    if disputed and here is not None and asked in owners:
        others = [copy for copy in owners.values() if copy.agent != asked]
        return _keep(found, here, others, "--here") if others else _keep_alone(found, here, "--here")
    if here is not None and here.acts:
        return _fine(f"leave it as it is: it runs on {asked}")
    if acting:
        (runs_on, *_) = acting
        return _nothing(
            f"migrate it, because it runs on {runs_on.agent}: pancakes task migrate {runs_on.agent}/{found.name} --to"
            f" {asked}"
        )
    if here is not None and here.is_paused:
        return _link(here) if _quorum(found) and not here.copied else _resume(found, here, "--here")
    paused = [copy for copy in found.copies if copy.is_paused]
    if paused:
        return _nothing(
            f"let it go on where it is paused, with its state: {_command(found, paused[0].agent, '--here')}"
        )
    if any(guard.hears_owner for guard in found.guards if guard.running):
        return _nothing(
            f"wait: the guardians of {task} hear its owner, {found.guards[0].owner}, which does not answer here"
        )
    if found.guards and _quorum(found) and any(guard.running for guard in found.guards):
        return _nothing(
            f"have its guardians take over, because more than half of them answer: {_command(found)}, without --here"
        )
    if here is not None and here.may_run:
        return _adopt(found, here, "--here")
    if here is not None and here.rest.startswith(WAITS):
        return _at_once(found, here)
    if here is not None and (here.state == FAILED or here.rest == FAILED or here.is_stopped):
        return _start(found, here, "--here")
    if found.able:
        return _revive(found, "--here")
    if found.unable:
        return _nothing(found.unable)
    return _nothing(
        f"pass --config FILE, with the configuration of its former agent: no agent that answers has a state of {task},"
        " so it can only begin from scratch"
    )


def _not_here(found: Findings) -> Proposal:
    """Return how the agent that the person named gives up what it has of the task, or why not."""
    asked, here = found.asked, found.copy(found.asked)
    if asked not in found.answers:
        return _nothing(f"wait until {asked} answers: only {asked} can give up what it has")
    if here is None:
        return _fine(f"leave it as it is: {asked} has nothing of {found.task_id}")
    disputed = [copy for copy in found.copies if copy.rest == DISPUTED]
    acting = [copy for copy in found.copies if copy.acts]
    owners = {copy.agent: copy for copy in (*disputed, *acting)}
    others = [copy for copy in owners.values() if copy.agent != asked]
    if disputed and asked in owners:
        if len(others) == 1:
            return msgspec.structs.replace(
                _keep(found, others[0], [here]), command=_command(found, asked, "--not-here")
            )
        return _nothing(
            f"wait until {here.other or 'the other owner'} answers: the copy on {asked} is the only one that does"
        )
    if here.may_leave:
        return _leave(found, here, others[0].agent if others else "")
    if here.acts or here.is_paused or here.is_stopped or FAILED in (here.state, here.rest):
        name = f"{asked}/{found.name}"
        return _nothing(
            f"leave it, because {asked} has the only copy. To stop it: pancakes task stop {name}. To migrate it:"
            f" pancakes task migrate {name}"
        )
    if here.waits or here.rest.startswith(WAITS):
        return _nothing(f"stop it, or {asked} starts it as soon as it can: pancakes task stop {asked}/{found.name}")
    return _fine(f"leave it as it is: {here.reason or f'{asked} does not start it by itself'}")


# What may have happened, in the order in which it is looked for --------------------------------------------------


def _told(found: Findings, trouble: Trouble, what: str, proposal: Proposal, *choices: Proposal | None) -> Diagnosis:
    others = tuple(it for it in choices if it is not None)
    return Diagnosis(task_id=found.task_id, trouble=trouble, what=what, proposal=proposal, choices=others)


def _two_owners(found: Findings) -> Diagnosis | None:
    disputed = [copy for copy in found.copies if copy.rest == DISPUTED]
    acting = [copy for copy in found.copies if copy.acts]
    why = "A backup was restored, a disk was copied or emptied, or a person started it a second time."
    if disputed:
        copy = disputed[0]
        if acting:
            owners = [*acting, *disputed]
            names = _names(sorted(it.agent for it in owners))
            what = f"{names} own {found.task_id}. {why} It runs on {acting[0].agent}, and is paused on {copy.agent}."
            keeps = [_keep(found, it, [one for one in owners if one is not it], "--here") for it in disputed]
            return _told(found, "two owners", what, _keep(found, acting[0], disputed), *keeps)
        if len(disputed) > 1:
            names = _names([it.agent for it in disputed])
            what = f"{names} own {found.task_id}, and it is paused on all of them. {why}"
            keeps = [_keep(found, it, [one for one in disputed if one is not it], "--here") for it in disputed]
            choose = _nothing("choose the copy to keep: nothing tells which of them has the state that you want")
            return _told(found, "two owners", what, choose, *keeps)
        other = copy.other or "another agent"
        what = (
            f"{copy.agent} and {other} own {found.task_id}. {why} It is paused on {copy.agent}, and {other} does not"
            " answer."
        )
        return _told(found, "two owners", what, _keep_alone(found, copy))
    if len(acting) > 1:
        where = _names([it.agent for it in acting])
        what = f"{found.task_id} runs on {where}, which do not know of each other's copy. {why}"
        stops = "; ".join(f"pancakes task stop {it.agent}/{found.name}" for it in acting)
        link = (
            f"link these agents: then one copy is paused, and this command keeps the one that you choose. To end a copy"
            f" at once: {stops}"
        )
        return _told(found, "two owners", what, _nothing(link))
    return None


def _runs(found: Findings) -> Diagnosis | None:
    """The task runs: what is left of it elsewhere, and actuators that refuse it."""
    acting = next((copy for copy in found.copies if copy.acts), None)
    if acting is None:
        return None
    where = acting.agent
    for copy in found.copies:
        # A migration that was cut off finishes by itself once both agents are linked again.
        if copy is acting or not copy.may_leave or (copy.in_doubt and copy.other in found.answers):
            continue
        trouble, story = _left_over(copy)
        what = f"{found.task_id} runs on {where}. {story} So {copy.agent} does not start it."
        return _told(found, trouble, what, _leave(found, copy, where))
    refusing = [it for it in found.actuators if it.refuses]
    if refusing:
        names = tuple(f"{it.agent}/{it.target}" for it in refusing)
        story = "; ".join(
            f"{name} has seen epoch {it.seen}, brought by {it.brought_by}"
            for name, it in zip(names, refusing, strict=True)
        )
        what = (
            f"{found.task_id} runs on {where} under epoch {refusing[0].owner_has}, but an actuator refuses it: {story}."
        )
        obey = Proposal(
            act="obey",
            agent=where,
            others=names,
            text=f"have {_names(names)} obey the copy on {where}, after a safe hold",
            only_if=f"{found.task_id} runs only on {where}",
            command=_command(found),
        )
        return _told(found, "disobeyed", what, obey)
    doubtful = [copy.agent for copy in found.copies if copy.in_doubt and copy is not acting]
    more = f" {_names(doubtful)} has not heard that yet, and asks until it has." if doubtful else ""
    return _told(found, "", f"{found.task_id} runs on {where}.{more}", _fine())


def _left_over(copy: Copy) -> tuple[Trouble, str]:
    if copy.rest == DISK_LOST:
        return "lost disk", f"The disk of {copy.agent} was lost or emptied."
    if copy.rest == OLD_COPY:
        return "copied disk", f"The disk of {copy.agent} is an older copy."
    if copy.in_doubt:
        return "in doubt", f"{copy.agent} keeps a migration from {copy.other} that was cut off."
    return "damaged record", f"The record of it on {copy.agent} was damaged."


def _guarded(found: Findings) -> Diagnosis | None:
    task = found.task_id
    paused = next((copy for copy in found.copies if copy.is_paused), None)
    if paused is not None:
        return _paused(found, paused)
    last = max((guard.epoch for guard in found.guards), default=0)
    guards = [guard for guard in found.guards if guard.epoch == last and guard.agent != guard.owner]
    if not any(guard.running for guard in guards):
        return None
    owner = guards[0].owner
    if any(guard.hears_owner for guard in guards):
        what = f"{task} runs on {owner}, which does not answer here: its guardians hear it."
        return _told(found, "", what, _fine())
    waits_s = max((guard.lease_left_s or 0.0 for guard in guards), default=0.0)
    if waits_s > 0.0:
        what = f"{owner}, which ran {task}, is silent. Its guardians wait until its lease is over."
        return _told(found, "silent owner", what, _nothing(f"wait {waits_s:.0f} s: then another agent takes it over"))
    take = found.take_over
    heard_s = min(guard.silent_s for guard in guards)
    if take is not None and take.taker:
        what = f"{owner}, which ran {task}, has been silent for {heard_s:.0f} s, and its guardians agree on that."
        proposal = Proposal(
            act="take",
            agent=take.asked,
            text=f"have its guardians let {take.taker} take it over, from {take.story}",
            lost="what it did since that checkpoint",
            command=_command(found, take.asked),
        )
        return _told(found, "silent owner", what, proposal)
    if _quorum(found):
        reason = take.refusal if take is not None else ""
        what = (
            f"{owner}, which ran {task}, has been silent for {heard_s:.0f} s. Its guardians answer, but no agent takes"
            " it over."
        )
        wait = _nothing(f"wait, and see why: {reason}" if reason else "wait a moment")
        return _told(found, "silent owner", what, wait)
    what = (
        f"{owner}, which ran {task}, is silent, and so are half or more of its guardians. So nobody can know whether it"
        " still runs."
    )
    if found.able:
        return _told(found, "guardians gone", what, _revive(found))
    return _told(found, "guardians gone", what, _nothing(found.unable or "start its guardians again"))


def _paused(found: Findings, copy: Copy) -> Diagnosis:
    """Its owner answers, and may not act."""
    if copy.copied:
        what = (
            f"{found.task_id} is paused on {copy.agent}, whose disk is a copy or was moved. So its guardians decide"
            " which agent runs it."
        )
        take = found.take_over
        if take is not None and take.taker:
            proposal = Proposal(
                act="take",
                agent=take.asked,
                text=f"have its guardians let {take.taker} take it over, from {take.story}",
                lost="what it did since that checkpoint",
                command=_command(found, take.asked),
            )
            return _told(found, "copied disk", what, proposal, _resume(found, copy, "--here"))
        return _told(found, "copied disk", what, _resume(found, copy))
    what = f"{found.task_id} is paused on {copy.agent}, because half or more of its guardians do not answer it."
    return _told(found, "guardians gone", what, _link(copy) if _quorum(found) else _resume(found, copy))


def _in_doubt(found: Findings) -> Diagnosis | None:
    doubtful = [copy for copy in found.copies if copy.in_doubt]
    if not doubtful:
        return None
    offers = {it.agent: (it.epoch, it.no) for it in found.checkpoints}
    copy = max(doubtful, key=lambda it: (offers.get(it.agent, ((0, ""), 0)), it.agent))
    what = (
        f"A migration of {found.task_id} between {copy.agent} and {copy.other} was cut off. It runs on neither, because"
        " neither can know what the other has decided."
    )
    if copy.other in copy.linked:
        again = (
            f"wait: it finishes by itself while {copy.agent} and {copy.other} are linked. If it does not, {copy.other}"
        )
        return _told(found, "in doubt", what, _nothing(f"{again} has lost its disk: switch it off, and try again"))
    if copy.other in found.answers:
        link = f"link {copy.agent} and {copy.other} again: both answer, and the migration then finishes by itself"
        return _told(found, "in doubt", what, _nothing(link), _adopt(found, copy, "--here") if copy.may_run else None)
    drop = _leave(found, copy) if copy.may_leave else None
    if copy.may_run:
        return _told(found, "in doubt", f"{what} {copy.other} does not answer.", _adopt(found, copy), drop)
    wait = _nothing(f"wait for {copy.other}: {copy.reason or f'{copy.agent} does not run it without'}")
    return _told(found, "in doubt", what, wait, drop)


def _undecided(found: Findings) -> Diagnosis | None:
    """An agent has the task in its configuration, and cannot know whether it runs elsewhere."""
    for copy in found.copies:
        if copy.rest == OLD_COPY:
            what = (
                f"The disk of {copy.agent} is an older copy, as other agents remember. So {found.task_id} is paused"
                " there."
            )
            start = f"start the agents that know where it is: {copy.reason}"
            return _told(found, "restored backup", what, _adopt(found, copy) if copy.may_run else _nothing(start))
    for copy in found.copies:
        if copy.rest == DISK_LOST:
            what = f"{copy.agent} knows nothing of {found.task_id}, but others do: its disk was lost or emptied."
            if found.able and found.checkpoints:
                return _told(found, "lost disk", what, _revive(found), _adopt(found, copy, "--here"))
            drop = _leave(found, copy) if copy.may_leave else None
            if copy.may_run:
                return _told(found, "lost disk", f"{what} No agent that answers runs it.", _adopt(found, copy), drop)
            return _told(found, "lost disk", what, _nothing(f"start the agent that has it: {copy.reason}"), drop)
    for copy in found.copies:
        if copy.rest.startswith(WAITS):
            others = copy.rest.removeprefix(WAITS)
            what = f"{copy.agent} says: {copy.reason}."
            wait = _nothing(f"start {others}, or correct peers in [agent] of {copy.agent}")
            return _told(found, "waits", what, wait, _at_once(found, copy))
    for copy in found.copies:
        if copy.rest == FORGOTTEN:
            what = f"A person decided that {copy.agent} does not run {found.task_id}. No agent that answers runs it."
            stays = _fine("leave it as it is, or take the decision back with --here")
            return _told(found, "", what, stays, _adopt(found, copy, "--here") if copy.may_run else None)
    for copy in found.copies:
        if copy.may_run and not copy.gave_to:
            what = (
                f"The record of {found.task_id} on {copy.agent} was damaged or lost. So {copy.agent} cannot know"
                " whether it runs elsewhere; no agent that answers runs it."
            )
            drop = _leave(found, copy) if copy.may_leave else None
            return _told(found, "damaged record", what, _adopt(found, copy), drop)
    return None


def _stopped(found: Findings) -> Diagnosis | None:
    for copy in found.copies:
        if copy.state == FAILED or copy.rest == FAILED:
            name, why = f"{copy.agent}/{found.name}", f": {copy.reason}" if copy.reason else ""
            what = f"{found.task_id} failed too often on {copy.agent}, and was given up{why}."
            drop = _nothing(f"begin from scratch: pancakes task restart {name} --drop-state")
            return _told(found, "given up", what, _start(found, copy), drop)
    for copy in found.copies:
        if copy.waits:
            what = f"{found.task_id} cannot start on {copy.agent}: {copy.reason}."
            return _told(found, "cannot start", what, _nothing("fix that: then it starts by itself"))
    for copy in found.copies:
        if copy.is_stopped:
            what = f"{found.task_id} is stopped on {copy.agent}: {copy.reason or 'nothing has started it'}."
            start = _fine(f"leave it as it is, or start it: pancakes task start {copy.agent}/{found.name}")
            return _told(found, "", what, start)
    return None


def _last_given_to(found: Findings) -> str:
    """Return the agent that the task was given to at last, as those say that have given it on; empty: none."""
    given = {copy.agent: copy.gave_to for copy in found.copies if copy.gave_to}
    agent = next(iter(given), "")
    for _ in given:  # a stale backup may make a circle of it
        agent = given.get(agent, agent)
    return agent


def _lost(found: Findings) -> Diagnosis:
    """No agent that answers has the task."""
    task, silent = found.task_id, " ".join(f"{it}." for it in found.silent)
    left = next((copy for copy in found.copies if copy.gave_to and copy.may_run), None)
    gone = _last_given_to(found)
    if gone in found.answers:
        what = (
            f"{task} was given to {gone}, which answers and has nothing of it: its disk was lost, or the task was"
            " removed there. No agent that answers runs it."
        )
        if left is not None:
            return _told(found, "lost disk", what, _adopt(found, left))
        scratch = _command(found, option="--here --config FILE")
        return _told(found, "lost disk", what, _nothing(found.unable or f"begin it from scratch: {scratch}"))
    if found.able:
        what = f"No agent that answers runs {task}. {silent}"
        return _told(found, "lost agent", what.strip(), _revive(found))
    if gone:
        what = f"{task} was given to {gone}, which does not answer. {silent}"
        if left is not None:
            return _told(found, "lost agent", what.strip(), _nothing(f"start {gone}"), _adopt(found, left, "--here"))
        start = (
            f"start {gone}. If it is gone for good, the task can only begin from scratch:"
            f" {_command(found, option='--here --config FILE')}"
        )
        return _told(found, "lost agent", what.strip(), _nothing(start))
    answers = _names(found.answers)
    scratch = _command(found, found.answers[0] if found.answers else "", "--here --config FILE")
    if found.asked not in found.answers:
        hint = found.hint or "."
        what = f"{found.asked} does not answer, and no agent that answers ({answers}) knows of {task}{hint} {silent}"
        start = (
            f"start {found.asked}. If it is gone for good, the task can only begin from scratch, on an agent that you"
            f" choose: {scratch}"
        )
        return _told(found, "lost agent", what.strip(), _nothing(found.unable or start))
    what = f"No agent that answers ({answers}) knows of a task {found.name}{found.hint or '.'} {silent}"
    check = (
        "check its name with pancakes task list. If its agent is gone for good, name an agent that should run the task"
        f" from scratch: {scratch}"
    )
    return _told(found, "unknown", what.strip(), _nothing(found.unable or check))


_CASES: Final[tuple[Callable[[Findings], Diagnosis | None], ...]] = (
    _two_owners,
    _runs,
    _guarded,
    _in_doubt,
    _undecided,
    _stopped,
    _lost,
)
