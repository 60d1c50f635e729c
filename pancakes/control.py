"""Control packets: how to change a running agent (paper §3.4).

A task, a service, another agent and a person at a terminal all publish the same packets on `sysctrl`. Each gets a
`Reply`, whose `cause` is the packet that asked. There is no other way to change a running system.

A `target` is read on the agent that the packet reaches: `task`, `service/task` or `service`. If a task and a service
have the same name, `service/` means the service. `CONTROLS` lists all control packets with the right that each needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import msgspec

from pancakes.errors import PancakesError, RefusalCode
from pancakes.packet import Cause, packet_type


@packet_type("create")
class Create(msgspec.Struct, frozen=True):
    """Create a task that no configuration file names, and start it; the answer comes once it runs.

    From then on it is like one that a file names: it survives a restart of its agent, migrates and is guarded, until
    `Remove` ends it. The asker needs the right `host` on its type too. The reply's `result` is a mapping: `task_id`,
    `epoch`, and `silent`, the agents that were asked in vain whether they know of such a task.

    Attributes:
        target: its name, or `service/name`; without a service, it is the Client Service's.
        type: name of its class, such as `encirclement.ScanTarget`.
        settings: plain values for its settings.
        rate_hz: the rate of its first timer; None: as its class says.
        keys: the other keys that its table `[task.NAME]` would have in a file, such as `guard` and `restart`.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    type: str
    settings: Mapping[str, Any] = {}
    rate_hz: float | None = None
    keys: Mapping[str, Any] = {}
    dry_run: bool = False


@packet_type("remove")
class Remove(msgspec.Struct, frozen=True):
    """Remove a task that no configuration file names: it stops, and its state is forgotten.

    The answer comes once that is on disk. A later task of its name starts without its state.

    Attributes:
        target: the task.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    dry_run: bool = False


SHORTEST_S: Final = 0.1
LONGEST_S: Final = 600.0
"""The shortest and the longest measurement, in seconds of host time."""


@packet_type("measure")
class Measure(msgspec.Struct, frozen=True):
    """Measure what an agent uses its processor time for; the reply comes at the end.

    The `result` is a mapping, with all times in seconds of processor time, of the measurement only:

    - `agent`; `speed` (mission seconds for each second of host time); `span_s` (host time that it took); `processor_s`
      (of the whole process); `turns` and `turn_s` (of all its actors);
    - `host`: its computer: `id` (the same for all agents on it), `processors` (how many), `busy_share` (of all of
      them), `yardstick_s` (how long a fixed piece of Python took: how fast they are);
    - `battery`: `before` and `after`, what was left of it, 0 to 1; None if it has none or has not read it;
    - `tasks`: a mapping for each task: `service`, `task`, `type`, `state`, `task_id` (empty if it cannot move),
      `turns`, `turn_s`, and `timers`, each with `timer`, `rate_hz`, `ticks`, `missed`, `tick_s`, `tick_s2` (sum of the
      squares of its ticks' times).

    Turns are timed only while something measures. In virtual time it is refused.

    Attributes:
        for_s: how long, in host time.
    """

    for_s: float = 5.0


@packet_type("start")
class Start(msgspec.Struct, frozen=True):
    """Start a stopped task or service.

    Attributes:
        target: what to start.
        settings: settings of a task that differ from the configuration's.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    settings: Mapping[str, Any] | None = None
    dry_run: bool = False


@packet_type("stop")
class Stop(msgspec.Struct, frozen=True):
    """Stop a task or a service, once it has finished its current message.

    Attributes:
        target: what to stop.
        for_s: a service starts again by itself after this time, in mission seconds; None: it does not.
        dry_run: only report whether it would be done, and change nothing.
        then: a task of the same service to start in the place of this one, once it has let its actuators go; empty:
            none. A task may ask for this for itself.
    """

    target: str
    for_s: float | None = None
    dry_run: bool = False
    then: str = ""


@packet_type("restart")
class Restart(msgspec.Struct, frozen=True):
    """Stop a task or a service and start it again.

    Attributes:
        target: what to restart.
        keep_state: whether a task (or each task of a service) goes on with its state and settings, or starts as its
            configuration says.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    keep_state: bool = True
    dry_run: bool = False


@packet_type("reload")
class Reload(msgspec.Struct, frozen=True):
    """Import a task type again as it is on disk now, and have its running tasks go on in the new class.

    Each goes on with its settings, its state and its identity, after a gap like that of a migration. The whole
    distribution of the type is imported again, so tasks of its other types go on in their new classes as well. If the
    import fails, or one task does not fit, all tasks go on as they are.

    The reply's `result` is a mapping: `distribution`, `before` and `version` (its versions), `tasks` (a list; each has
    `service`, `task`, `type`, `state`, and `reason`, which is empty unless the task goes on in its old class), and
    `stays` (drivers and services of the distribution, which go on as they are until the agent starts again).

    Attributes:
        type: the task type, such as `encirclement.ScanTarget`.
        dry_run: only import it and check the tasks, and change nothing.
    """

    type: str
    dry_run: bool = False


@packet_type("reschedule")
class Reschedule(msgspec.Struct, frozen=True):
    """Change the rate of a time-driven task, from its next tick on.

    Attributes:
        target: the task.
        rate_hz: ticks for each second of mission time; 0 stops the ticks.
        timer: the method that ticks, if the task has several; empty: the first.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    rate_hz: float
    timer: str = ""
    dry_run: bool = False


@packet_type("configure")
class Configure(msgspec.Struct, frozen=True):
    """Change some settings of a running task; if one of them is wrong, nothing changes.

    Attributes:
        target: the task.
        settings: the new values, by name. For wrong ones the reply's `result` has `problems`, each with
            `path` and `text`.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    settings: Mapping[str, Any]
    dry_run: bool = False


@packet_type("migrate")
class Migrate(msgspec.Struct, frozen=True):
    """Migrate a running task to the neighbour that takes it for the lowest cost.

    Attributes:
        target: the task.
        to: the only neighbour to ask; empty: all of them.
        then: a task to start here once this one has gone.
        cost: the cost function that the neighbours answer with, or the weight of each of several.
        dry_run: only ask for bids, and migrate nothing.
    """

    target: str
    to: str = ""
    then: str = ""
    cost: str | dict[str, float] = "tasks"
    dry_run: bool = False


@packet_type("allocate")
class Allocate(msgspec.Struct, frozen=True):
    """Begin a round of the team's allocation: which agent gets which of the tasks that are allocated.

    The `result` is a plain mapping, that of the round's account: see docs/allocation.md.

    Attributes:
        dry_run: only report what would be done, and migrate nothing.
    """

    dry_run: bool = False


@packet_type("adopt")
class Adopt(msgspec.Struct, frozen=True):
    """Run a task here on a person's word that it runs nowhere else.

    Its migration is in doubt, and the other agent is gone for good; or this agent's own record of it was lost, or the
    disk of the agent that it was given to; or another agent owns it too, and this copy should live. If the person is
    wrong, two copies run: no other request can do that.

    Attributes:
        target: the task.
        birthplace: the agent that the task was born on, if two tasks of its name are in doubt here.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    birthplace: str = ""
    dry_run: bool = False


@packet_type("forget")
class Forget(msgspec.Struct, frozen=True):
    """Leave a task stopped here, on a person's word that it runs elsewhere.

    If this agent has lost its record of the task, it neither starts it nor asks about it from then on; `Adopt` takes
    that back. If another agent owns the task too, this copy and its state are given up, and packets for the task go to
    the other agent. If another agent has brought the task and is gone, without telling whether it was given away, what
    is here of it is dropped. In all cases the task may migrate to this agent later like any other.

    Attributes:
        target: the task.
        birthplace: the agent that the task was born on, if two tasks of its name are undecided here.
        owner: the agent that keeps it, if two own it; empty: the record of it was lost.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    birthplace: str = ""
    owner: str = ""
    dry_run: bool = False


class HeldCheckpoint(msgspec.Struct, frozen=True):
    """A checkpoint of a task, as an agent holds it.

    Attributes:
        snapshot: the task, encoded.
        epoch: the epoch under which it was written, and the agent that minted it.
        no: its sequence number under that epoch.
        story: which one it is, which agent holds it and how old it is, as a clause.
    """

    snapshot: bytes
    epoch: tuple[int, str]
    no: int
    story: str


@packet_type("revive")
class Revive(msgspec.Struct, frozen=True):
    """Run a task here whose agent is gone for good: from a checkpoint, or from its configuration, without state.

    A guarded task that is here, and is paused because its guardians are gone for good, goes on as it is. Its epoch is
    so high that no actuator takes its commands for old, and that a lost agent pauses its copy when it comes back.

    Attributes:
        task_id: the task, as `birthplace/name`.
        type: name of its class, such as `encirclement.ScanTarget`; this and all to `guard` are for one that starts from
            scratch.
        service: the service here that looks after it.
        settings: plain values for its settings.
        restart: what its service does when it fails, as in `[task.NAME] restart`; empty: the default.
        durability: `lazy` or `each`.
        migrate: its rule for moving, as in `[task.NAME] migrate`; None: it has none.
        guard: how it is guarded, a `GuardRule` as plain values; None: it is not.
        checkpoint: what it goes on from; None: it starts from scratch.
        seen: the highest epoch number that any agent knows of it.
        dry_run: only report whether it would be done, and change nothing.
    """

    task_id: str
    type: str = ""
    service: str = "client"
    settings: dict[str, Any] = {}
    restart: dict[str, Any] = {}
    durability: Literal["lazy", "each"] = "lazy"
    migrate: dict[str, Any] | None = None
    guard: dict[str, Any] | None = None
    checkpoint: HeldCheckpoint | None = None
    seen: int = 0
    dry_run: bool = False


@packet_type("set_fence")
class SetFence(msgspec.Struct, frozen=True):
    """Set the fence of an actuator for a task to the epoch under which the task runs now, wherever it runs.

    Use it if the actuator no longer obeys the task: the agent that had the task is gone, or one that never had it
    brought a higher epoch. The actuator goes to its safe hold, and its agent asks all that it is connected to.

    Attributes:
        target: the actuator.
        task_id: the task, as `birthplace/name`.
        dry_run: only report what would be done, and change nothing.
    """

    target: str
    task_id: str
    dry_run: bool = False


@packet_type("migrations")
class Migrations(msgspec.Struct, frozen=True):
    """Ask an agent for the newest accounts of migrations from it, also those of earlier boots.

    The `result` is a list of plain mappings, oldest first: those of `MigrationReport`, `number`, `boot`, `mission_s`,
    `reason`.
    """


@packet_type("guarding")
class Guarding(msgspec.Struct, frozen=True):
    """Ask an agent which guarded tasks it owns, and which it guards.

    The reply's `result` is a list of plain mappings. Each has `task_id`, `agent`, `owner` (the agent that its guardian
    follows), `epoch`, `checkpoint` (the number of the newest that it holds), `age_s` (how long ago the task was in
    that state, in host seconds), `silent_s` (since it heard the owner), `lease` (whether the owner's runs there),
    `lease_left_s` (for how long yet, in host seconds, unless it is renewed; None: none runs) and `wanted` (whether the
    task should run). That of the owner has `guardians`, `changing` (whether these are being changed: until new ones
    have its state, it does not migrate), `guard` (their number as wanted), `permit_s`, `held_back` (acts that came too
    late, by kind), `clock_steps` and `no_dead_man` (actuators that do not hold) too.
    """


@packet_type("checkpoints")
class Checkpoints(msgspec.Struct, frozen=True):
    """Ask an agent for the checkpoints of a task that it holds: as its guardian, or of a migration that is in doubt.

    The reply's `result` is a list of plain mappings: `task_id`, `agent`, `held` (`guardian` or `in doubt`), `type`,
    `service`, `wanted`, `epoch` (number and minter) and `no` of the checkpoint, `age_s` (None: unknown), `at_least` (it
    may be older), `seen` (the highest number of an epoch that is known), `guardians` (one or two lists of agents),
    `peer` (the other agent of a migration that is in doubt), and `snapshot` if it was asked for.

    Attributes:
        task: its name; empty: all tasks.
        birthplace: the agent that it was born on; empty: any.
        body: whether the snapshots are wanted too.
    """

    task: str
    birthplace: str = ""
    body: bool = False


@packet_type("take")
class Take(msgspec.Struct, frozen=True):
    """Have a guarded task taken over whose owner is silent; ask one of its guardians.

    More than half of the guardians must confirm that no lease of the owner runs.

    Attributes:
        task: its name.
        birthplace: the agent that it was born on, if two of its name are guarded here.
        dry_run: only report which agent would take it, and from which checkpoint.
    """

    task: str
    birthplace: str = ""
    dry_run: bool = False


@packet_type("describe")
class Describe(msgspec.Struct, frozen=True):
    """Ask what an agent is and runs; the reply's `result` is plain.

    Attributes:
        target: a task (the result is a mapping with all that is known about it, its settings and their JSON Schema
            among it), a service (a list with a row for each of its tasks); empty: the agent (a mapping with a row for
            each service and task).
        state: of a task that runs: its state too (`state`), between two of its turns, and when (`mission_s`, `host_s`).
        began: of a task that runs: when it began as well, and what it carried then (`began`).
        config: of the agent: its configuration (`config`), where values were set (`said`), the tasks `created` on it.
    """

    target: str = ""
    state: bool = False
    began: bool = False
    config: bool = False


@packet_type("channels")
class Channels(msgspec.Struct, frozen=True):
    """Ask which channels an agent has; the reply's `result` is a list of plain mappings, core channels first.

    Each has `agent`, `channel`, `core` (whether it cannot be removed), `subscribers` (a list of mappings: `address`,
    `types` or None for all, `open_types`: those of them that it gets without being addressed, `queue`: as in
    `@on(queue=...)`, `limit`: of all its types together, `waiting`, `waiting_bytes`: of the large bodies among these,
    `dropped`: lost by one that wants more than the newest) and `followers` (agents that it is forwarded to).

    Attributes:
        channel: only this one; empty: all.
    """

    channel: str = ""


@packet_type("history")
class History(msgspec.Struct, frozen=True):
    """Ask the Log Service for the records of `log`; the `result` is a list, oldest first.

    A record has what a line of the service's file has: `t_s` (mission time), `agent`, `source`, `kind`, and what
    belongs to that kind (`line`: `level` and `text`); and its `entry`, its number since the service began. A reply has
    as many as fit: for the rest it is asked again, with the last `entry` as `after`, until the list is empty.

    Attributes:
        since_s: only records of this many last seconds of mission time; None: all that are still known.
        after: only entries after this one.
    """

    since_s: float | None = None
    after: int = 0


@packet_type("shutdown")
class Shutdown(msgspec.Struct, frozen=True):
    """Stop an agent gracefully: tasks stop, actuators hold, peers are told. The answer comes before that.

    Attributes:
        dry_run: only report whether it would be done, and change nothing.
    """

    dry_run: bool = False


@packet_type("reload_keys")
class ReloadKeys(msgspec.Struct, frozen=True):
    """Make an agent take the new key in the place of the old one now; by itself it looks each minute.

    New links use it, and the old ones are made again, one after the other. The reply's result is whether there is one.

    Attributes:
        dry_run: only report whether there is one.
    """

    dry_run: bool = False


@packet_type("begin")
class Begin(msgspec.Struct, frozen=True):
    """Begin a mission that is held at 0.

    Attributes:
        in_s: in how many seconds of host time; a duration, because the clocks of two agents differ.
    """

    in_s: float = 0.0


@packet_type("follow")
class Follow(msgspec.Struct, frozen=True):
    """Ask an agent to send the asker what is published on one of its channels.

    Attributes:
        channel: the channel.
        types: only packets of these types; empty: all.
        include_remote: whether packets count that came to that channel from other agents.
        most_hz: at most this many packets a second (host time) of each source and type, the newest that came, together;
            for a client that only shows the present state. 0.001 or more; 0: all, each at once.
    """

    channel: str
    types: tuple[str, ...] = ()
    include_remote: bool = False
    most_hz: float = 0.0


@packet_type("traces")
class Traces(msgspec.Struct, frozen=True):
    """Ask an agent what led to the commands of its actuators; for a program that watches.

    From the first question on the agent notes its newest packets, until ten seconds pass without a question. The
    `result` has `now_ns` and `until_ns` (the next `since_ns`), `left_out` (how many commands there was no
    room for), and `rows`: the packets, oldest first, that are commands or led to one, or to one of `packets`, as far as
    they were seen on this agent. A row is a list: when it was seen, channel, type, source, number, stamp, source and
    number of its cause (empty and 0 if it has none), and its content in a few words. Times are the time of day in
    nanoseconds, as in a recording. Packets on `log` and `sysctrl` are left out.

    Attributes:
        since_ns: only commands that were given after this.
        packets: source and number of packets of this agent that led to commands elsewhere.
        most: at most this many commands, of more an even choice. 0: the asker stops asking, and gets no result.
    """

    since_ns: int = 0
    packets: tuple[Cause, ...] = ()
    most: int = 100


@packet_type("unfollow")
class Unfollow(msgspec.Struct, frozen=True):
    """End what `Follow` began.

    Attributes:
        channel: the channel.
    """

    channel: str


@packet_type("halt")
class Halt(msgspec.Struct, frozen=True):
    """Bring all actuators of an agent to their safe hold, and keep them there until a person sends `EndHalt`.

    The agent tells its neighbours, which halt as well and tell theirs. If it is halted already, that halt stays. A halt
    is on disk before the answer comes, so an agent that is started again is still halted. The `result` is a mapping:
    `halt` (None, or a mapping with `id`, `origin`, `by`, `reason` and `spread`), `actuators` (those that stand),
    `late` (those that did not in time), and `not_on_disk` (why it could not be written; empty: it was).

    Attributes:
        reason: why, for people.
        spread: whether the neighbours halt too.
        dry_run: only report what would stand, and change nothing.
        id: names the halt, if several agents are asked for the same one; empty: the agent draws a name.
    """

    reason: str = ""
    spread: bool = True
    dry_run: bool = False
    id: str = ""


@packet_type("end_halt")
class EndHalt(msgspec.Struct, frozen=True):
    """Let the actuators of an agent move again. Only a person may, from a terminal, a script or a page.

    What tasks command from then on is carried out at once. It ends the halt of this agent only. The `result` is that of
    `Halt`.

    Attributes:
        dry_run: only report whether it would be done, and change nothing.
        id: the halt that is meant, as `Describe` tells it: another one that lasts by now is not ended. Empty: any.
    """

    dry_run: bool = False
    id: str = ""


@packet_type("drive")
class Drive(msgspec.Struct, frozen=True):
    """Drive an actuator by hand, at a velocity that is good until the device's `drive_stop_s` is over.

    A drive lasts from the packet with `begin` to `EndDrive`, or until no packet came for 5 s of host time. Meanwhile a
    task `device/drive-DEVICE` has the actuator. The task that held it before is paused, commands of all others are
    refused, and no task starts that requires it. The first packet after a silence of `drive_stop_s` is answered, not
    obeyed: it may have waited for a link. The `result` is a mapping: `device`, `driver` (who drives, an address),
    `late` (whether this packet was such a one), `stop_after_s` (within this host time the next packet must come),
    `paused` (the address of the task that waits; empty: none does), and `filters` (what the actuator's filters do now,
    as in `Describe`).

    Attributes:
        target: the actuator, whose commands are `Twist`s.
        id: names the drive, a random text: a packet of another drive is refused.
        v_mps: forward speed.
        omega_radps: turning rate, counter-clockwise.
        begin: whether it begins a drive; refused if somebody else drives.
        take: with `begin`: take over from somebody else who drives.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    id: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    v_mps: float = 0.0
    omega_radps: float = 0.0
    begin: bool = False
    take: bool = False
    dry_run: bool = False


@packet_type("end_drive")
class EndDrive(msgspec.Struct, frozen=True):
    """End a drive: the actuator goes to its safe hold, and the task that waits goes on.

    Attributes:
        target: the actuator.
        id: the drive, as in `Drive`.
        dry_run: only report whether it would be done, and change nothing.
    """

    target: str
    id: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    dry_run: bool = False


class Refusal(msgspec.Struct, frozen=True):
    """Tell why something is refused. `docs/refusals.md` lists the codes.

    Attributes:
        code: the reason for programs.
        text: the reason for people, a sentence that says what to do next.
        retry_after_s: after how long another try may succeed, in seconds; None: not before something changes.
    """

    code: RefusalCode
    text: str
    retry_after_s: float | None = None

    @classmethod
    def of(cls, error: Exception) -> Refusal:
        """Return the refusal that an error leads to."""
        if isinstance(error, PancakesError):
            return cls(error.code, str(error), error.retry_after_s)
        return cls("invalid" if isinstance(error, ValueError) else "failed", str(error))

    @classmethod
    def if_any(cls, text: str, code: RefusalCode = "unable") -> Refusal | None:
        """Return the refusal for a reason; None if the reason is empty."""
        return cls(code, text) if text else None


@packet_type("reply")
class Reply(msgspec.Struct, frozen=True):
    """Answer a control packet; the `cause` of the reply's packet names it.

    Attributes:
        refusal: why what was asked for has not been done; None: it has.
        result: what was asked for, if it was a question.
        number: its place in the one order in which the agent takes all control packets, from 1 after its start; the
            events on `log` that it led to have the same number.
    """

    refusal: Refusal | None = None
    result: Any = None
    number: int = 0

    @property
    def ok(self) -> bool:
        """Whether what was asked for has been done."""
        return self.refusal is None

    @property
    def reason(self) -> str:
        """Why it has not been done, as a sentence; empty: it has."""
        return self.refusal.text if self.refusal is not None else ""


@packet_type("hold")
class Hold(msgspec.Struct, frozen=True):
    """Tell an actuator, on `ctrl`, to go to its safe hold at once; only its holder's service may.

    Attributes:
        reason: why, for the log.
    """

    reason: str


ControlRight = Literal["look", "change", "adopt", "move", "end", "halt", "drive"]
"""What a peer needs to be obeyed; docs/security.md has a line for each."""
CONTROLS: Final[Mapping[type, ControlRight]] = {
    Create: "change",
    Remove: "change",
    Start: "change",
    Stop: "change",
    Take: "move",
    Restart: "change",
    Reload: "change",
    Reschedule: "change",
    Configure: "change",
    Migrate: "move",
    Allocate: "move",
    Adopt: "adopt",
    Forget: "adopt",
    Guarding: "look",
    Checkpoints: "look",
    Revive: "adopt",
    SetFence: "change",
    Migrations: "look",
    Describe: "look",
    Measure: "look",
    Channels: "look",
    History: "look",
    Shutdown: "end",
    Halt: "halt",
    EndHalt: "change",
    Drive: "drive",
    EndDrive: "drive",
    ReloadKeys: "change",
    Begin: "change",
    Follow: "look",
    Unfollow: "look",
    Traces: "look",
}
"""All that can be asked for, and the right that it needs; a dry run needs `look`, but not one that runs new code."""


@packet_type("command")
class Command(msgspec.Struct, frozen=True):
    """Carry a control packet from the kernel to the service that it concerns.

    All control packets to an agent pass one place, which numbers them, so contradictory ones are applied in one order.

    Attributes:
        number: its place in that order, from 1.
        request: source and number of the packet that asked.
        task: the name of the task that it is about; empty if it is about the service.
        body: the control packet's body; None: the service must end, now that it has begun all that it was asked before.
        for_s: if it must end: after how many seconds of mission time it starts again; None: it does not by itself.
    """

    number: int
    request: Cause
    task: str
    body: Any = msgspec.field(default=None)
    for_s: float | None = None
