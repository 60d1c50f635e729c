"""Find running agents, ask them by control packets, and wait for their replies: `MeshClient`, below `Client`.

A client starts from addresses, or from the runtime directory of this machine. Each agent that answers names its peers,
so the client learns the whole fleet. Its threads may block; those of agents may not.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from pancakes.client.session import Door, FleetWay, Greeting, Waits, Wishes
from pancakes.control import Describe, Reply
from pancakes.errors import ControlRefused, NoAnswer, PancakesError, Unreachable
from pancakes.mesh.address import DEFAULT_FLEET, dialled, fleet_in, in_fleet, is_local, reachable_from
from pancakes.mesh.messages import Hello
from pancakes.mesh.peers import reachable
from pancakes.security.key_store import fleets_of_person
from pancakes.util.clock import MonotonicClock
from pancakes.util.runtime_dir import entries, why_none
from pancakes.util.text import fault_of_name, hint_of


@dataclass(frozen=True, slots=True)
class Where:
    """Where agents are looked for.

    Attributes:
        addresses: addresses to begin with (`tcp://127.0.0.1:7401`); none: what runs on this machine.
        fleet: only agents of this fleet; empty: of any.
    """

    addresses: tuple[str, ...] = ()
    fleet: str = ""

    @classmethod
    def of(cls, at: Where | str | Sequence[str]) -> Where:
        """Returns the place that is meant by an address, by several, or by what is one already.

        Raises:
            PancakesError: one of them is no address at which an agent could be, or the fleet has no name.
        """
        if isinstance(at, Where):
            if at.fleet and (fault := fault_of_name(at.fleet)):
                raise PancakesError(fault)
            return cls(_addresses(at.addresses), at.fleet)
        return cls(_addresses((at,) if isinstance(at, str) else at))


def _addresses(texts: Sequence[str]) -> tuple[str, ...]:
    try:
        return tuple(dict.fromkeys(dialled(text) for text in texts))
    except ValueError as error:
        raise PancakesError(str(error)) from None


@dataclass
class Survey:
    """What the agents say about themselves.

    Attributes:
        agents: the result of `Describe` of each that answered, by fleet and name.
        silent: a sentence for each that did not.
        asleep: those of these sentences whose agent had said that its network would sleep.
    """

    agents: list[dict[str, Any]] = field(default_factory=list)
    silent: list[str] = field(default_factory=list)
    asleep: list[str] = field(default_factory=list)


@dataclass
class Replies:
    """What the agents answer that were all asked the same.

    Attributes:
        replies: the name of each that answered, and its reply, by fleet and name.
        silent: a sentence for each that did not.
    """

    replies: list[tuple[str, Reply]]
    silent: list[str]


@dataclass
class Lead:
    """An agent that is known to be somewhere.

    Attributes:
        address: where; empty where it cannot be dialled.
        fleet: its fleet; empty while that is not known.
        name: its name, likewise.
        failed: why it cannot be asked; empty while it can.
        here: whether the runtime directory of this machine names it.
    """

    address: str
    fleet: str = ""
    name: str = ""
    failed: str = ""
    here: bool = False

    def __str__(self) -> str:
        return f"{self.name} ({self.address})" if self.name and self.address else self.name or self.address

    def silence(self, why: str) -> str:
        """Returns a sentence that it gave no answer, and why; empty: that is not known."""
        if why.startswith(f"{self.address} "):  # it names the address itself
            return f"{self}{why.removeprefix(self.address)}"
        return f"{self} did not answer" + (f": {why}" if why else "")


Answers = dict[tuple[str, str], Reply]
"""Replies by the fleet and the name of the agent."""


class MeshClient:
    """Speaks to the agents of this machine, or to those at given addresses, and through any of them to their fleets.

    Any thread may use it. `pancakes.client.Client` stands on it, and so does what watches a whole fleet:

        with MeshClient(timeout_s=3.0) as client:
            reply = client.request("agent1", Stop("client/ScanTarget"))

    Args:
        at: an address to begin with (`HOST:PORT`, `tcp://HOST:PORT` or `local://NAME`), or several; none: what runs on
            this machine. A `Where` names a fleet as well.
        timeout_s: the time limit of each call.

    Attributes:
        wishes: what is followed, on which channels of which agents.

    Raises:
        PancakesError: one of them is no address, or the runtime directory cannot be used.
    """

    def __init__(self, at: Where | str | Sequence[str] = (), timeout_s: float = 3.0) -> None:
        where = Where.of(at)
        self.timeout_s = timeout_s
        self._clock = MonotonicClock()
        self._ways: dict[str, FleetWay] = {}
        self._lock = threading.RLock()
        self._waits = Waits(self._clock, self._lock)
        self.wishes = Wishes()
        self._doors: dict[str, Door] = {}
        self._greeted = 0
        self._leads: list[Lead] = []
        self._at = where.addresses
        self._fleet = where.fleet
        fleet = self._fleet or DEFAULT_FLEET
        try:
            for lead in [Lead(in_fleet(address, fleet)) for address in self._at] or self._running():
                self._follow(lead)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> MeshClient:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves all fleets; a thread that still waits is told so by an error."""
        self._waits.close()
        with self._lock:
            doors = list(self._doors.values())
        for door in doors:
            door.close()
        for way in self._ways.values():
            way.transport.close()

    def request(self, agent: str, body: Any, timeout_s: float | None = None) -> Reply:
        """Asks one agent for something, and waits for its answer.

        Args:
            agent: its name.
            body: a control packet's body, such as `Stop("client/ScanTarget")`.
            timeout_s: the time limit; None: that of the client.

        Returns:
            Its reply; where `ok` is False, its `reason` says why not.

        Raises:
            Unreachable: there is no such agent.
            NoAnswer: it was asked, and does not answer in time.
            PancakesError: agents of two fleets bear this name, or the body cannot travel, so it was not asked.
        """
        until_s = self._until_s(timeout_s)
        door = self._door_of(agent, until_s)
        number = door.request(agent, body)
        self.wait(until_s, lambda: door.answer(number) is not None)
        answer = door.answer(number)
        door.forget(number)
        if isinstance(answer, Reply):
            return answer
        raise NoAnswer(f"{agent} did not answer: {answer or self._late(timeout_s)}")

    def survey(self, *agents: str, timeout_s: float | None = None) -> Survey:
        """Asks all agents what they are and run; those that agents know of are asked as well.

        Args:
            agents: only these; empty strings do not count.
            timeout_s: the time limit; None: that of the client.

        Raises:
            Unreachable: no agent answers in time, or there is no agent of a name.
            ControlRefused: agents of two fleets bear a name.
        """
        replies, silent = self._gather(None, agents, timeout_s)
        return Survey(
            [reply.result for _, reply in replies],
            [sentence for sentence, _ in silent],
            [sentence for sentence, asleep in silent if asleep],
        )

    def ask_each(self, body: Any, *agents: str, timeout_s: float | None = None) -> Replies:
        """Asks all agents the same, all at once; the arguments and errors are those of `survey`.

        Args:
            body: a control packet's body that changes nothing, such as `Channels()`.
            agents: see `survey`.
            timeout_s: see `survey`.
        """
        replies, silent = self._gather(body, agents, timeout_s)
        return Replies(replies, [sentence for sentence, _ in silent])

    def is_there(self, agent: str, fleet: str = "") -> bool:
        """Returns whether an agent of this name can be reached: as soon as it is, or once all others have answered.

        Args:
            agent: its name.
            fleet: only where it is of this fleet; empty: of any.
        """

        if not self.is_connected(agent, fleet):
            self._ask_all(self._until_s(None), lambda answers: self.is_connected(agent, fleet))
        return self.is_connected(agent, fleet)

    def is_connected(self, agent: str, fleet: str = "") -> bool:
        """Returns whether an agent can be asked now; waits for nothing. The arguments are those of `is_there`."""
        with self._lock:
            return any(door.connected(agent) for door in self._doors.values() if fleet in ("", door.fleet))

    def narrow(self, fleet: str) -> None:
        """Speaks to the agents of one fleet alone from now on."""
        with self._lock:
            self._fleet = fleet
            self._leads = [lead for lead in self._leads if lead.fleet in ("", fleet)]
            left = [door for door in self._doors.values() if door.fleet != fleet]
            self._doors = {name: door for name, door in self._doors.items() if name == fleet}
        for door in left:
            door.close()

    # For what goes on ------------------------------------------------------------------------------------------

    def now(self) -> float:
        """Returns the host time, in seconds."""
        return self._clock.now()

    def wait(self, until_s: float, condition: Callable[[], bool]) -> bool:
        """Waits until the condition is true, at most until a host time; returns whether it is.

        It is looked at whenever an agent comes, goes, answers or sends something, and now and then.

        Raises:
            PancakesError: the client is closed, or is closed meanwhile.
        """
        return self._waits.until(until_s, condition)

    def is_own(self, name: str) -> bool:
        """Returns whether a name of the mesh is that of this client in a fleet."""
        return any(way.name == name for way in self._ways.values())

    def door(self, agent: str) -> Door:
        """Returns the door through which a connected agent is reached.

        Raises:
            Unreachable: it is not connected now.
            ControlRefused: agents of two fleets bear this name.
        """
        found = [door for door in self.doors() if door.connected(agent)]
        self._must_be_one(agent, [door.fleet for door in found])
        if not found:
            raise Unreachable(f"{agent} is not connected")
        return found[0]

    def doors(self) -> list[Door]:
        """Returns the doors of the fleets that are known by now."""
        with self._lock:
            return list(self._doors.values())

    def look_again(self) -> None:
        """Finds agents of this machine that were started since (where none was named), and dials those that are away.

        Agents of this machine that have ended since are looked for no more.

        Raises:
            PancakesError: the runtime directory cannot be used.
        """
        running = [] if self._at else self._running()
        with self._lock:
            known = {(lead.fleet, lead.name, lead.address) for lead in self._leads}
            new = [lead for lead in running if (lead.fleet, lead.name, lead.address) not in known]
            moved = {(lead.fleet, lead.name) for lead in new}
            there = {(lead.fleet, lead.name) for lead in running}
            self._leads = [
                lead
                for lead in self._leads
                if (lead.fleet, lead.name) not in moved
                and (not lead.here or (lead.fleet, lead.name) in there or self.is_connected(lead.name, lead.fleet))
            ]
            for lead in new:
                self._follow(lead)
            for door in self._doors.values():
                ours = [lead for lead in self._leads if lead.fleet == door.fleet and lead.address]
                if away := [lead.address for lead in ours if not door.connected(lead.name)]:
                    door.dial_again(away)

    def greet_again(self) -> None:
        """Asks once more which agents are at the addresses at which none was found."""
        with self._lock:
            for lead in [it for it in self._leads if it.failed and it.address and not it.name]:
                self._leads.remove(lead)
                self._follow(Lead(lead.address))

    # Finding them ----------------------------------------------------------------------------------------------

    def _running(self) -> list[Lead]:
        """Returns the agents of this machine that are looked for."""
        there = [entry for entry in entries() if entry.role != "client" and self._fleet in ("", entry.fleet)]
        return [Lead(next(iter(entry.listen), ""), entry.fleet, entry.name, here=True) for entry in there]

    def _nowhere(self) -> str:
        """Returns a sentence to say where no agent runs."""
        if not self._at:
            return why_none(self._fleet)
        of = f" of the fleet {self._fleet}" if self._fleet else ""
        return f"no agent{of} runs at {', '.join(self._at)}"

    def _follow(self, lead: Lead) -> None:
        """Finds out which agent is there, and reaches it through its fleet's door."""
        self._leads.append(lead)
        if not lead.address:
            lead.failed = lead.failed or "it listens at no address, so it cannot be asked from here"
            return

        def told(what: Hello | str) -> None:
            with self._lock:
                self._met(lead, what)
            self._waits.tell()

        self._greeted += 1
        fleet = self._fleet_at(lead)
        way = self._way(fleet)
        Greeting(way.transport, lead.address, f"{way.name}.{self._greeted}", fleet, self._clock, told)

    def _way(self, fleet: str) -> FleetWay:
        """Returns how the agents of a fleet are reached."""
        made = self._ways.get(fleet)
        if made is None:
            made = self._ways[fleet] = FleetWay.to(fleet, self._clock)
        return made

    def _fleet_at(self, lead: Lead) -> str:
        """Returns the fleet of which the agent there is thought to be: an agent tells those of its fleet alone."""
        if found := lead.fleet or self._fleet or fleet_in(lead.address):
            return found
        with suppress(PancakesError):  # an agent elsewhere can be asked without the runtime directory
            if here := [entry.fleet for entry in entries() if lead.address in entry.listen]:
                return here[0]
        own = fleets_of_person()
        if len(own) > 1 and DEFAULT_FLEET not in own and not is_local(lead.address):
            raise PancakesError(f"you have keys of {len(own)} fleets: say which with --fleet ({', '.join(own)})")
        return own[0] if len(own) == 1 else DEFAULT_FLEET

    def _met(self, lead: Lead, what: Hello | str) -> None:
        if isinstance(what, str):
            fleet = self._fleet_at(lead)
            keyless = not is_local(lead.address) and self._way(fleet).keys is None
            keyless = keyless and not what.startswith(f"{lead.address} ")  # nobody is there to ask for them
            lead.failed = f"{what} (you have no keys of the fleet {fleet} to show it)" if keyless else what
        elif lead.name and (lead.name, lead.fleet) != (what.name, what.fleet):
            lead.failed = f"at its address is {what.name} of the fleet {what.fleet}"
        elif self._fleet not in ("", what.fleet):
            lead.failed = f"it is {what.name} of the fleet {what.fleet}, not of {self._fleet}"
        else:
            lead.name, lead.fleet = what.name, what.fleet
            door = self._doors.get(what.fleet)
            if door is None:
                way = self._way(what.fleet)
                door = Door(way.name, what.fleet, way.transport, self._clock, self._waits.tell, way.keys)
                self._doors[what.fleet] = door
            door.learn(lead.address)
        # One that is not there yet is dialled again and again, as soon as another of its fleet is.
        for other in self._leads:
            if other.failed and (later := self._doors.get(fleet_in(other.address))) is not None:
                later.learn(other.address)

    def _learn(self, door: Door, description: dict[str, Any]) -> None:
        """Follows the agents that one of them is connected to."""
        fleet, remote = door.fleet, door.place_of(description["agent"])
        if not remote:
            return
        way = self._way(fleet)
        keyless = way.keys is None and not description["insecure"]
        for peer in description["mesh"]["peers"]:
            if peer["role"] == "client" or any((it.fleet, it.name) == (fleet, peer["name"]) for it in self._leads):
                continue
            there = [reachable(it, remote) for it in reachable_from(remote, peer["addresses"], way.transport.reach)]
            failed = ""
            if keyless and not all(is_local(it) for it in there):
                there = [it for it in there if is_local(it)] or self._here(fleet, peer["name"])
                failed = f"you have no keys of the fleet {fleet}, which agents ask for over tcp://"
            unmet = next((it for it in self._leads if not it.name and it.address in there), None)
            if unmet is not None and not unmet.failed:
                unmet.fleet, unmet.name = fleet, peer["name"]
            else:
                if unmet is not None:  # it was not there yet
                    self._leads.remove(unmet)
                self._follow(Lead(next(iter(there), ""), fleet, peer["name"], failed))

    def _here(self, fleet: str, name: str) -> list[str]:
        """Returns where an agent is reached within this machine; nothing where it does not run here."""
        with suppress(PancakesError):
            there = [next(iter(it.listen), "") for it in entries() if (it.fleet, it.name) == (fleet, name)]
            return [address for address in there if is_local(address)]
        return []

    # Waiting ---------------------------------------------------------------------------------------------------

    def _gather(
        self, body: Any, agents: Sequence[str], timeout_s: float | None
    ) -> tuple[list[tuple[str, Reply]], list[tuple[str, bool]]]:
        """See `survey`; body: what else to ask them for, None: only to describe themselves.

        Returns:
            The replies, and for each that was silent a sentence, and whether its network sleeps.
        """
        wanted = [name for name in dict.fromkeys(agents) if name]

        def enough(answers: Answers) -> bool:
            return bool(wanted) and all(
                self._is_there(name, {it[0] for it in answers if it[1] == name}) for name in wanted
            )

        answers, silent = self._ask_all(self._until_s(timeout_s), enough, body, wanted)
        with self._lock:
            if wanted:
                for name in wanted:
                    self._must_be_one(name, [fleet for fleet, other in answers if other == name])
                    if all(it[1] != name for it in answers) and all(lead.name != name for lead, _ in silent):
                        raise Unreachable(self._nobody(name, sorted({other for _, other in answers}), silent))
                answers = {key: reply for key, reply in answers.items() if key[1] in wanted}
                silent = [(lead, why) for lead, why in silent if lead.name in wanted]
            asleep = {(door.fleet, name) for door in self._doors.values() for name in door.asleep()}
            sentences = [
                (lead.silence(why or self._late(timeout_s)), (lead.fleet, lead.name) in asleep) for lead, why in silent
            ]
            if not answers:
                raise Unreachable(
                    "\n".join(sentence for sentence, _ in sentences)
                    or f"{self._nowhere()}: start one, or name one with --at"
                )
            return [(key[1], answers[key]) for key in sorted(answers)], sentences

    def _ask_all(
        self, until_s: float, enough: Callable[[Answers], bool], body: Any = None, wanted: Sequence[str] = ()
    ) -> tuple[Answers, list[tuple[Lead, str]]]:
        """Asks all agents that can be found to describe themselves.

        Args:
            until_s: when to give up.
            enough: whether the answers so far will do.
            body: what else to ask them for; its answer is then the one that counts.
            wanted: only these agents are asked for that; none: all.

        Returns:
            The answers, and the agents that have given none, with the reason where one is known.
        """
        asked: dict[tuple[str, str], tuple[Door, int]] = {}
        described: set[tuple[str, str]] = set()
        answers: Answers = {}
        failed: dict[tuple[str, str], str] = {}

        def silent() -> Iterator[tuple[Lead, str]]:
            for lead in self._leads:
                key = (lead.fleet, lead.name)
                if key not in answers:
                    yield lead, lead.failed or failed.get(key, "")

        def take(key: tuple[str, str], door: Door, reply: Reply) -> None:
            if key in described:
                answers[key] = reply
                return
            described.add(key)
            self._learn(door, reply.result)
            if body is not None and (not wanted or key[1] in wanted):
                door.forget(asked[key][1])
                asked[key] = door, door.request(key[1], body)
            else:
                answers[key] = reply

        def done() -> bool:
            for door in list(self._doors.values()):
                for hello in door.agents():
                    key = (door.fleet, hello.name)
                    if key not in asked:
                        asked[key] = door, door.request(hello.name, Describe())
                for name, for_s in door.asleep().items():
                    failed[door.fleet, name] = "its network sleeps" + ("" if for_s is None else f" for {for_s:.1f} s")
                for address, why in door.refused().items():
                    for lead in self._leads:
                        if (lead.fleet, lead.address) == (door.fleet, address) and not door.connected(lead.name):
                            failed[door.fleet, lead.name] = why
            for key, (door, number) in list(asked.items()):
                answer = door.answer(number)
                if isinstance(answer, str):
                    failed[key] = answer
                elif answer is not None and not answer.ok and key not in described:
                    failed[key] = answer.reason
                elif answer is not None and key not in answers:
                    take(key, door, answer)
            return enough(answers) or all(why for _, why in silent())

        self.wait(until_s, done)
        with self._lock:
            for door, number in asked.values():
                door.forget(number)
            return answers, list(silent())

    def _door_of(self, agent: str, until_s: float) -> Door:
        """Returns the door through which an agent is reached, once it is."""

        def doors() -> list[Door]:
            return [door for door in self._doors.values() if door.connected(agent)]

        def there() -> bool:
            return self._is_there(agent, {door.fleet for door in doors()})

        with self._lock:
            known = there()
        answers, silent = ({}, []) if known else self._ask_all(until_s, lambda answers: there())
        with self._lock:
            found = doors()
        self._must_be_one(agent, [door.fleet for door in found])
        if found:
            return found[0]
        why = next((why or "it did not answer in time" for lead, why in silent if lead.name == agent), "")
        if why:
            raise Unreachable(f"{agent} cannot be reached: {why}")
        raise Unreachable(self._nobody(agent, sorted({name for _, name in answers}), silent))

    def _is_there(self, agent: str, found: set[str]) -> bool:
        """Whether an agent has been found, given the fleets in which one of its name has been.

        All that are known to be there by that name are waited for, so that two of one name are seen.
        """
        named = {lead.fleet for lead in self._leads if lead.name == agent and not lead.failed}
        return bool(found) and named <= found

    def _must_be_one(self, agent: str, fleets: Sequence[str]) -> None:
        if len(fleets) > 1:
            several = " and ".join(sorted(fleets))
            raise ControlRefused(f"the fleets {several} both have an agent {agent}: name one of them with --fleet")

    def _nobody(self, agent: str, names: list[str], silent: Iterable[tuple[Lead, str]]) -> str:
        silent = list(silent)
        lines = [lead.silence(why) for lead, why in silent]
        there = f"there is no agent {agent!r}{hint_of(agent, names)}"
        if not names:
            there = f"no agent knows of an agent {agent!r}" if lines else self._nowhere()
        if silent and not any(lead.name for lead, _ in silent) and not names:
            return "\n".join(lines)  # nobody was reached who could know of it
        return "\n".join([*lines, there])

    def _until_s(self, timeout_s: float | None) -> float:
        return self._clock.now() + (self.timeout_s if timeout_s is None else timeout_s)

    def _late(self, timeout_s: float | None) -> str:
        return f"nothing came within {self.timeout_s if timeout_s is None else timeout_s:g} s"
