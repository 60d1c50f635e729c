"""Ask all agents that can be reached about a task in trouble.

Nothing changes: what an agent would do on a person's word is asked by dry runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import msgspec

from pancakes.client import Client
from pancakes.control import (
    Adopt,
    Checkpoints,
    Describe,
    Forget,
    Guarding,
    HeldCheckpoint,
    Reply,
    Revive,
    SetFence,
    Take,
)
from pancakes.durable.record import DISK_LOST, MOVED, OLD_COPY, WAITS
from pancakes.errors import ControlRefusedError, PancakesError
from pancakes.packet import LOG, NETWORK, join
from pancakes.tools.recovery.diagnosis import (
    ACTING,
    DISPUTED,
    FAILED,
    Actuator,
    Checkpoint,
    Copy,
    Findings,
    Guard,
    TakeOver,
    newest,
)
from pancakes.util.text import did_you_mean

IN_DOUBT: Final = "in doubt"
_OF_EACH_AGENT: Final = (LOG, NETWORK)
"""Services whose tasks each agent has, and which never migrate."""


class Asked(msgspec.Struct, frozen=True):
    """Which task a person means.

    Attributes:
        agent: the agent that its name begins with.
        task: its name.
        service: its service; empty: any.
        birthplace: the agent that it was born on; empty: not given.
    """

    agent: str
    task: str
    service: str = ""
    birthplace: str = ""

    @property
    def target(self) -> str:
        """The task as an agent reads its name."""
        return join(self.service, self.task) if self.service else self.task


class Survey:
    """What all agents report, asked once for any number of tasks.

    Args:
        client: asks the agents.

    Attributes:
        agents: the descriptions of those that answer, by name.
        silent: a sentence for each that does not.

    Raises:
        UnreachableError: no agent answers.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        described = client.describe()
        self.agents: dict[str, dict[str, Any]] = {agent["agent"]: agent for agent in described.agents}
        self.silent = tuple(it for it in described.silent if it not in described.asleep)
        self.guards = self._all(Guarding())
        self.checkpoints = self._all(Checkpoints(""))
        self._marks: list[tuple[str, str, Mapping[str, Any]]] | None = None

    def _all(self, body: Any) -> list[dict[str, Any]]:
        replies = self._client.request_all(body, *self.agents).replies
        return [row for _, reply in replies if reply.ok for row in reply.result]

    def _each(self, body: Any) -> dict[str, Reply]:
        return dict(self._client.request_all(body, *self.agents).replies)

    def _ask(self, agent: str, body: Any) -> Reply | None:
        try:
            return self._client.request(agent, body)
        except PancakesError:
            return None  # it has gone since

    # Which tasks are in trouble --------------------------------------------------------------------------------

    def suspects(self) -> list[Asked]:
        """Return the tasks that may be in trouble, each once for each agent that makes one think so."""
        found = [
            Asked(name, row["task"], row["service"])
            for name, agent in self.agents.items()
            for row in agent["tasks"]
            if self._is_suspect(row)
        ]
        found += [
            Asked(row["agent"], row["task_id"].partition("/")[2], "", row["task_id"].partition("/")[0])
            for row in (*self.guards, *self.checkpoints)
            if row.get("held") == IN_DOUBT or ("lease" in row and row["wanted"] and not _guard(row).hears_owner)
        ]
        for agent, target, mark in self._all_marks():
            birthplace, _, task = mark["task_id"].partition("/")
            actuators = self._actuators([(agent, target, mark)], mark["task_id"])
            found += [Asked(it.owner, task, "", birthplace) for it in actuators if it.refuses]
        return list(dict.fromkeys([*found, *self._twice()]))

    def _twice(self) -> Iterator[Asked]:
        """Yield the tasks that run on two agents, which need not know of each other. Most of one name are different."""
        by_name: dict[str, list[tuple[str, dict[str, Any]]]] = {}
        for name, agent in self.agents.items():
            for row in agent["tasks"]:
                if row["state"] in ACTING and not row.get("device") and row["service"] not in _OF_EACH_AGENT:
                    by_name.setdefault(row["task"], []).append((name, row))
        for rows in by_name.values():
            seen = set()
            for name, row in rows if len(rows) > 1 else ():
                detail = self._detail(name, row)
                fence = detail.get("fence")
                if fence is None or detail["state"] not in ACTING:
                    continue
                task_id = fence["task_id"]
                if task_id in seen:
                    yield Asked(name, row["task"], "", task_id.partition("/")[0])
                seen.add(task_id)

    def _is_suspect(self, row: Mapping[str, Any]) -> bool:
        rest, guarding = row["rest"], row.get("guarding")
        if rest in (DISPUTED, DISK_LOST, OLD_COPY, FAILED) or rest.startswith(WAITS) or row["waits"]:
            return True
        if rest.startswith(MOVED) and not self._may_have(rest.removeprefix(MOVED), row["task"]):
            return True
        if row["state"] == "stopped" and rest == "" and row["reason"]:
            return True  # such as one whose record is damaged
        paused = guarding is not None and (guarding["copied"] or (row["state"] in ACTING and not guarding["permit_s"]))
        return paused or row["state"] == FAILED

    def _may_have(self, agent: str, task: str) -> bool:
        """Return whether an agent lists a task, or does not answer but is linked to one that does."""
        described = self.agents.get(agent)
        if described is not None:
            return any(row["task"] == task for row in described["tasks"])
        return any(agent in it["neighbours"] for it in self.agents.values())

    # One task --------------------------------------------------------------------------------------------------

    def look(self, asked: Asked, here: bool = False, begins: Revive | None = None, file: str = "") -> Findings:
        """Return what all agents report about one task.

        Args:
            asked: the task.
            here: whether it should run on the agent that was named; otherwise any agent may.
            begins: how it begins from scratch; None: no configuration was given.
            file: the configuration file that it begins from, for the command that is shown.

        Raises:
            ControlRefusedError: several tasks may be meant.
        """
        rows = {name: row for name, agent in self.agents.items() if (row := self._row(agent, asked)) is not None}
        details = {name: self._detail(name, row) for name, row in rows.items()}
        rows |= {name: dict(it) for name, it in details.items() if it}  # newer: the task may have migrated meanwhile
        services = {row["service"] for row in rows.values()}
        # An agent that does not list the task knows only by the name of its service whom to ask.
        target = join(services.pop(), asked.task) if not asked.service and len(services) == 1 else asked.target
        adopts = self._each(Adopt(target, asked.birthplace, dry_run=True))
        ids = {name: _id_of(name, row, details[name], adopts.get(name)) for name, row in rows.items()}
        task_id = begins.task_id if begins is not None else self._meant(asked, rows, ids, adopts)
        birthplace = task_id.partition("/")[0]
        if any(reply.refusal is not None and reply.refusal.code == "ambiguous" for reply in adopts.values()):
            adopts = self._each(Adopt(target, birthplace, dry_run=True))
        leaves = self._each(Forget(target, birthplace, dry_run=True))
        copies = [
            copy
            for name in self.agents
            if (
                copy := self._copy(
                    name, task_id, rows.get(name) if ids.get(name) == task_id else None, details, adopts, leaves
                )
            )
            is not None
        ]
        copies = self._with_epochs(copies, asked, birthplace)
        checkpoints = [_checkpoint(row) for row in self.checkpoints if row["task_id"] == task_id]
        guards = [_guard(row) for row in self.guards if row["task_id"] == task_id]
        acting = [copy for copy in copies if copy.acts]
        actuators = self._actuators(self._all_marks(), task_id) if len(acting) == 1 else []
        found = Findings(
            task_id=task_id,
            asked=asked.agent,
            answers=tuple(self.agents),
            silent=self.silent,
            copies=tuple(copies),
            checkpoints=tuple(checkpoints),
            guards=tuple(guards),
            actuators=tuple(actuators),
            service=asked.service,
            hint=self._hint(asked),
        )
        if acting:
            return found
        found = msgspec.structs.replace(found, take_over=self._take_over(found, asked, birthplace))
        if begins is not None:
            return self._begins(found, begins, file)
        return self._revives(found, here)

    def _hint(self, asked: Asked) -> str:
        """Return tasks that may be meant instead of one that nobody knows, as a clause."""
        rows = [row for agent in self.agents.values() for row in agent["tasks"]]
        same = sorted({join(row["agent"], row["task"]) for row in rows if row["task"] == asked.task})
        if same:
            return f", only of {' and '.join(same)}."
        return did_you_mean(asked.task, [row["task"] for row in rows])

    def _row(self, agent: Mapping[str, Any], asked: Asked) -> dict[str, Any] | None:
        wanted = asked.service if agent["agent"] == asked.agent else ""
        found = [it for it in agent["tasks"] if it["task"] == asked.task and wanted in ("", it["service"])]
        if len(found) > 1 and agent["agent"] == asked.agent:
            choices = " or ".join(join(asked.agent, it["service"], it["task"]) for it in found)
            raise ControlRefusedError(f"{asked.agent} has several tasks {asked.task!r}: use {choices}", "ambiguous")
        return found[0] if found else None

    def _detail(self, agent: str, row: Mapping[str, Any]) -> Mapping[str, Any]:
        reply = self._ask(agent, Describe(join(row["service"], row["task"])))
        return reply.result if reply is not None and reply.ok and isinstance(reply.result, dict) else {}

    def _meant(
        self,
        asked: Asked,
        rows: Mapping[str, Mapping[str, Any]],
        ids: Mapping[str, str],
        adopts: Mapping[str, Reply],
    ) -> str:
        """Return the id of the task that is meant: the agent's own, or one that it has, had or is offered.

        An agent that answers and has nothing of the task may be the one that should run it.

        Raises:
            ControlRefusedError: several may be meant.
        """
        if asked.birthplace:
            return join(asked.birthplace, asked.task)
        told = [row for row in (*self.guards, *self.checkpoints) if row["task_id"].partition("/")[2] == asked.task]
        offers = {name: reply.result for name, reply in adopts.items() if reply.ok}
        own = join(asked.agent, asked.task)
        near = [ids.get(asked.agent)]
        near += [row["task_id"] for row in told if asked.agent in (row["agent"], row.get("owner"), row.get("peer"))]
        near += [ids[name] for name, row in rows.items() if row["rest"] == MOVED + asked.agent]
        near += [
            offer["task_id"]
            for name, offer in offers.items()
            if asked.agent in (name, offer["peer"]) and not (asked.agent in ids and offer.get("moved"))
        ]
        everything = {*ids.values(), *(offer["task_id"] for offer in offers.values())}
        everything.update(row["task_id"] for row in told)
        if own in everything and ids.get(asked.agent, own) == own:
            return own
        for some in ({it for it in near if it}, everything if asked.agent in self.agents else set[str]()):
            if len(some) == 1:
                return next(iter(some))
            if some:
                raise ControlRefusedError(
                    f"{' and '.join(sorted(some))} may be meant: choose one with --birthplace AGENT", "ambiguous"
                )
        return own

    def _copy(
        self,
        name: str,
        task_id: str,
        row: Mapping[str, Any] | None,
        details: Mapping[str, Mapping[str, Any]],
        adopts: Mapping[str, Reply],
        leaves: Mapping[str, Reply],
    ) -> Copy | None:
        adopt, leave = adopts.get(name), leaves.get(name)
        offer = adopt.result if adopt is not None and adopt.ok and adopt.result["task_id"] == task_id else {}
        moved, may_run = offer.get("moved", False), offer.get("runs", bool(offer))
        may_leave = leave is not None and leave.ok and leave.result["task_id"] == task_id
        doubted = [
            it for it in self.checkpoints if (it["agent"], it["held"], it["task_id"]) == (name, IN_DOUBT, task_id)
        ]
        if row is None and not (offer or may_leave or doubted):
            return None
        linked = tuple(self.agents[name]["neighbours"])
        peer = offer.get("peer", "")
        copy = Copy(
            agent=name,
            service="",
            rest=f"{MOVED}{peer}" if moved else "",
            other=doubted[0]["peer"] if doubted else "" if moved else peer,
            in_doubt=bool(doubted),
            may_run=may_run,
            may_leave=may_leave,
            linked=linked,
            reason=adopt.reason if adopt is not None and doubted and not may_run else "",
        )
        if row is None:
            return copy
        guarding = row.get("guarding") or {"permit_s": 1.0, "copied": False}
        fence = details.get(name, {}).get("fence")
        return msgspec.structs.replace(
            copy,
            service=row["service"],
            state=row["state"],
            rest=row["rest"],
            reason=row["reason"] or copy.reason,
            waits=row["waits"],
            epoch=fence["epoch"] if fence is not None and fence["task_id"] == task_id else None,
            permit=bool(guarding["permit_s"]),
            copied=guarding["copied"],
        )

    def _with_epochs(self, copies: Sequence[Copy], asked: Asked, birthplace: str) -> list[Copy]:
        """Ask two owners for the epochs of their copies; a copy that does not run does not show its epoch."""
        others = {copy.other for copy in copies if copy.rest == DISPUTED and copy.other}
        found = []
        for copy in copies:
            reply = None
            if copy.rest == DISPUTED and copy.epoch is None:
                owner = copy.other or next(iter(others), copy.agent)
                reply = self._ask(copy.agent, Forget(asked.task, birthplace, owner, dry_run=True))
            number = reply.result["epoch"].partition("@")[0] if reply is not None and reply.ok else ""
            found.append(msgspec.structs.replace(copy, epoch=int(number)) if number else copy)
        return found

    def _take_over(self, found: Findings, asked: Asked, birthplace: str) -> TakeOver | None:
        """Ask a guardian which agent would take the task over; None: no guardian answers, or the task has an owner."""
        guards = [it for it in found.guards if it.running]
        if not guards or any(it.lease_left_s is not None for it in guards):
            return None
        asks = next((it.agent for it in guards if it.agent == asked.agent), guards[0].agent)
        reply = self._ask(asks, Take(asked.task, birthplace, dry_run=True))
        if reply is None or not reply.ok:
            return TakeOver(asks, refusal=reply.reason if reply is not None else f"{asks} does not answer")
        result = reply.result
        age = f"{result['age_s']:.1f} s old when its owner was last heard, {result['silent_s']:.0f} s ago"
        return TakeOver(asks, result["winner"], f"checkpoint {result['checkpoint']}, {age}")

    # From a checkpoint, or from scratch ------------------------------------------------------------------------

    def _begins(self, found: Findings, begins: Revive, file: str) -> Findings:
        tried = self._ask(found.asked, msgspec.structs.replace(begins, dry_run=True))
        able = found.asked if tried is not None and tried.ok else ""
        unable = tried.reason if tried is not None else ""
        return msgspec.structs.replace(found, able=able, unable=unable, configuration=file)

    def _revives(self, found: Findings, here: bool) -> Findings:
        held = found.checkpoints if here else [it for it in found.checkpoints if it.guardians]
        if not held:
            return found
        body = self.revival(found.task_id, newest(held), found.service)
        holders = [it.agent for it in held]
        first = [found.asked] if found.asked in self.agents else []
        candidates = list(dict.fromkeys([*first, *([] if here else [*holders, *self.agents])]))
        reasons = []
        for name in candidates:
            tried = self._ask(name, msgspec.structs.replace(body, dry_run=True)) if body is not None else None
            if tried is not None and tried.ok:
                return msgspec.structs.replace(found, able=name)
            reasons += [tried.reason] if tried is not None else []
        return msgspec.structs.replace(found, unable="; ".join(reasons))

    def revival(self, task_id: str, checkpoint: Checkpoint, service: str = "") -> Revive | None:
        """Fetch a checkpoint, and return the request that runs the task from it; None: its holder has a newer one.

        Args:
            task_id: the task.
            checkpoint: the checkpoint.
            service: the service that should run it; empty: the same as before.
        """
        birthplace, _, name = task_id.partition("/")
        reply = self._ask(checkpoint.agent, Checkpoints(name, birthplace, body=True))
        bodies = reply.result if reply is not None and reply.ok else []
        body = next((it for it in bodies if (tuple(it["epoch"]), it["no"]) == (checkpoint.epoch, checkpoint.no)), None)
        if body is None:
            return None
        seen = max(row["seen"] for row in (*self.checkpoints, body) if row["task_id"] == task_id)
        held = HeldCheckpoint(body["snapshot"], checkpoint.epoch, checkpoint.no, checkpoint.story)
        return Revive(task_id, service=service or body["service"], checkpoint=held, seen=seen)

    # Actuators -------------------------------------------------------------------------------------------------

    def _all_marks(self) -> list[tuple[str, str, Mapping[str, Any]]]:
        """Return what actuators have seen of tasks: agent, `service/device`, and the mark."""
        if self._marks is None:
            self._marks = list(self._ask_marks())
        return self._marks

    def _ask_marks(self) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
        for name, agent in self.agents.items():
            for row in agent["tasks"]:
                if not row.get("device") or row["state"] not in ACTING:
                    continue
                target = join(row["service"], row["task"])
                reply = self._ask(name, Describe(target))
                for mark in reply.result.get("fences", ()) if reply is not None and reply.ok else ():
                    yield name, target, mark

    def _actuators(self, marks: Sequence[tuple[str, str, Mapping[str, Any]]], task_id: str) -> list[Actuator]:
        found = []
        for agent, target, mark in marks:
            if mark["task_id"] != task_id:
                continue
            tried = self._ask(agent, SetFence(target, task_id, dry_run=True))
            told = tried.result if tried is not None and tried.ok else {"owner": "", "now": ""}
            lines = self.agents[agent].get("warnings", ())
            warned = any(it["source"] == join(agent, target) and task_id in it["text"] for it in lines)
            seen = f"{mark['epoch']}@{mark['minter']}"
            found.append(Actuator(agent, target, seen, mark["brought_by"], told["owner"], told["now"], warned))
        return found


def _id_of(name: str, row: Mapping[str, Any], detail: Mapping[str, Any], adopt: Reply | None) -> str:
    """Return the id of an agent's task; what its service says nothing of is the agent's own."""
    if "task_id" in detail:
        return str(detail["task_id"])
    if (guarding := row.get("guarding")) is not None:
        return str(guarding["task_id"])
    if (fence := detail.get("fence")) is not None:
        return str(fence["task_id"])
    if adopt is not None and adopt.ok:
        return str(adopt.result["task_id"])
    return join(name, row["task"])


def _checkpoint(row: Mapping[str, Any]) -> Checkpoint:
    n, minter = row["epoch"]
    guardians = tuple(tuple(group) for group in row["guardians"])
    return Checkpoint(row["agent"], (n, minter), row["no"], story_of(row), guardians, row["wanted"] == "running")


def story_of(row: Mapping[str, Any]) -> str:
    """Describe a checkpoint, its age and its holder in a clause."""
    n, minter = row["epoch"]
    stopped = "" if row["wanted"] == "running" else f", of a task that should be {row['wanted']}"
    if row["age_s"] is None:
        return f"the state in the migration {n}@{minter}, held by {row['agent']}{stopped}"
    least = "at least " if row["at_least"] else ""
    return f"checkpoint {n}@{minter}/{row['no']}, {least}{row['age_s']:.1f} s old, held by {row['agent']}{stopped}"


def _guard(row: Mapping[str, Any]) -> Guard:
    number = int(row["epoch"].partition("@")[0])
    return Guard(row["agent"], row["owner"], number, row["lease_left_s"], row["silent_s"], row["wanted"])
