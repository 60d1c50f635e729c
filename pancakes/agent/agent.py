"""An agent, put together from its configuration (the composition root): kernel, services, mesh, journal."""

from __future__ import annotations

import math
import random
import threading
import uuid
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.agent.composition import Composition
from pancakes.agent.log_buffers import EarlyLog, RecentWarnings
from pancakes.agent.transport_settings import (
    addresses_of,
    insecure_over,
    keys_for,
    network_settings,
    transport_settings,
)
from pancakes.config import Config
from pancakes.config.state_dir import state_dir_of
from pancakes.control import CONTROLS, Refusal
from pancakes.durable.answers import Boot, BootMemory, NeighbourUp
from pancakes.durable.client_service import ClientService
from pancakes.durable.courier import COURIER, Courier, Outbox
from pancakes.durable.host_state import IMPORTER, HostState, Importer, describe_process
from pancakes.durable.installed import Installed
from pancakes.durable.messages import REGISTRAR
from pancakes.durable.questions import BirthRule
from pancakes.durable.quotas import kept_of_peers
from pancakes.durable.record import resting
from pancakes.durable.register import Identity as Owner
from pancakes.durable.registrar import Registrar
from pancakes.durable.store import RECORD, MigrationReports, Records
from pancakes.errors import PancakesError, describe, traceback_of
from pancakes.events import Event
from pancakes.journal import Disk, FileJournal, Journal, MemoryJournal, RecordStore, ThreadedStore, VirtualStore
from pancakes.kernel.actor import Component
from pancakes.kernel.dispatchers import defer
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import tell
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.link import LinkTimes
from pancakes.mesh.links import DROPS_REPORTED_EVERY_S
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.messages import Hello, Identity
from pancakes.mesh.session import Gate
from pancakes.mesh.sockets import ADVICE
from pancakes.mesh.transport import SocketTransport, Transport
from pancakes.mesh.trust import UNCHECKED, can_check
from pancakes.packet import LOG, SYSCTRL, Packet, body_class, first_number, join
from pancakes.security.access import Access
from pancakes.security.roster import Roster
from pancakes.service import Service
from pancakes.services.device import DeviceService
from pancakes.services.fence import Fences, FencesOfAgent
from pancakes.services.halt import Halts, PeerMet
from pancakes.services.log import LogService, wanted_recordings
from pancakes.services.network import NetworkService
from pancakes.services.root import Root
from pancakes.services.service_supervisor import Closer, MissionStart
from pancakes.supervision.messages import Close, NoRoom, PeerDown
from pancakes.util.clock import SkewedClock
from pancakes.util.files import FileMark
from pancakes.util.plugins import Plugins
from pancakes.util.text import printable

if TYPE_CHECKING:
    from pancakes.security.keys import Keys


_TOLD_ONCE = ("name", "role", "fleet", "listen")
"""What the description of an agent itself says, so its mesh need not repeat it."""
CLOSE_S = 1.5
"""How long, in host time, an agent waits for its tasks to end before it stops all the same."""


MOST_EARLY: Final = 1000
"""How many messages with control packets wait, at most, until the network of an agent runs."""


class Virtual(msgspec.Struct, frozen=True):
    """What an agent in virtual time shares with the others of its fleet.

    Attributes:
        dispatcher: runs them all.
        transport: this agent's transport on the network in memory.
        journal: the journal, which takes the place of its disk.
        clock: its host clock; None: the virtual one.
    """

    dispatcher: VirtualDispatcher
    transport: Transport
    journal: MemoryJournal
    clock: SkewedClock | None


class Agent:
    """One agent: a kernel, its services and their tasks, a mesh and a journal.

    Args:
        config: its configuration.
        plugins: where its classes come from.
        virtual: run in virtual time; None: on threads and sockets.
        arguments: what its tasks get besides their settings, by the task's name and by argument.

    Attributes:
        name: its name.
        kernel: its kernel.
        mesh: its links.
        store: writes to its journal.
        skipped: a sentence for each part that does not run or is not believed: a broken plug-in, a torn journal entry.
        outbox: what its tasks have sent to tasks, until that is acknowledged.
        host_state: what this host offers to a task from elsewhere.
        resting: why each task of its configuration that does not start now does not, in a word (`moved → r3`), by
            `SERVICE/TASK`: it migrated, failed or was stopped when the agent ran before.
        ready: set once everything that should run at the start runs.
        insecure_over: the schemes, such as `tcp://`, that it uses without the keys that they need; empty: none.
        fatal: why it must stop, as a sentence: its port is in use, another agent has its name, and so on.

    Raises:
        PancakesError: a plug-in is missing, its journal is in use, ...; the message says which.
    """

    def __init__(
        self,
        config: Config,
        plugins: Plugins | None = None,
        virtual: Virtual | None = None,
        arguments: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.config = config
        self.name = config.agent.name
        self._plugins = plugins or Plugins()
        seed = config.agent.seed if config.agent.seed is not None else random.SystemRandom().getrandbits(63)
        self.kernel = Kernel(
            self.name,
            seed=seed,
            speed=config.clock.speed,
            hold=True,  # until `MissionStart`
            virtual=virtual.dispatcher if virtual is not None else None,
            skewed=virtual.clock if virtual is not None else None,
        )
        self.ready = threading.Event()
        self.fatal: str = ""
        self.insecure_over = ""
        self._keys: Keys | None = None
        self.stopping = threading.Event()
        self._on_fatal: Callable[[str], None] = lambda reason: None
        self._on_shutdown: Callable[[], None] | None = None
        self._born_s = self.kernel.host.now()
        self._root: Root | None = None
        self._closed = threading.Event()  # once all services have ended
        self._clients: set[str] = set()
        self._drop_logged_s = -math.inf
        self._early_log = EarlyLog(self.ready)
        # What was asked of it before its network runs, when no answer would leave; None: it runs.
        self._early: list[tuple[str, Sequence[Packet], int]] | None = []
        self._early_lock = threading.Lock()
        self.skipped: list[str] = []
        self.skipped.extend(str(fault) for fault in self._plugins.load_packets())
        journal = virtual.journal if virtual is not None else self._open_journal()
        try:
            self._compose(config, journal, virtual, arguments or {})
        except BaseException:
            journal.close()
            self.kernel.stop()
            raise

    def _compose(
        self,
        config: Config,
        journal: Journal,
        virtual: Virtual | None,
        arguments: Mapping[str, Mapping[str, Any]],
    ) -> None:
        network = network_settings(self.config)
        transport = virtual.transport if virtual is not None else self._open_transport()
        self.kernel.transport = transport
        own, permits = config.access, self.kernel.permits
        self.kernel.access = Access(self.name, self._roster if self._keys is not None else None, own.allow, own.refuse)
        if virtual is None:
            transport.lend_thread(self.kernel.guest, network.busy_poll_s)
        store: RecordStore
        if virtual is not None:
            store = VirtualStore(virtual.journal, transport.call_later, self.kernel.host.now, self.kernel.log)
        else:
            store = ThreadedStore(
                journal, f"{self.name}-journal", self.kernel.host.now, self.kernel.log, self._journal_lost, defer
            )
        self.store = store
        self.kernel.life, self.kernel.first_number = f"{journal.uuid}/{journal.boot}", first_number(journal.life)
        self._remarks, self.kernel.disk_use = journal.remarks, lambda: journal.use
        self._config_files = {path: FileMark(path if virtual is None else "") for path in config.places.files}
        self._warnings = RecentWarnings(self.kernel.tasks)
        self.kernel.stream.tap(LOG, lambda packet: self._warnings.take(packet, self.kernel.host.now()), ("line",))
        disk = Disk(journal, store, self.skipped)
        self._boots = BootMemory(disk)
        self.records = Records(disk, Owner(self.name, journal.uuid, journal.copy), self._boots.journals())
        self.resting = self._resting()
        self._halts = Halts(disk, self.kernel)
        self.ledgers = MigrationReports(disk, self.kernel.log)
        self._installed = installed = Installed(self._plugins)
        self.host_state = HostState(self.kernel, config.agent.role, installed, self.records)
        addresses, fault = (config.agent.addresses, "") if virtual is not None else addresses_of(config.agent, network)
        if fault:
            self.skipped.append(f"{self.name} cannot be reached at {config.agent.addresses[0]}: {fault}")
        lost = self.records.all_lost()
        told = {(RECORD, str(one.task_id)) for one in lost}
        self.skipped.extend(str(aside) for aside in journal.set_aside if (aside.kind, aside.key) not in told)
        self.skipped.extend(f"{one.task_id} is not started: {one.undecided(self.name)}" for one in lost)
        fleet, role = config.agent.fleet, config.agent.role
        self.mesh = Mesh(
            Identity(self.name, journal.uuid, journal.boot, fleet, role, journal.life, journal.copy),
            transport,
            addresses,
            config.agent.peers,
            self.kernel.random_for("mesh"),
            self.kernel.host,
            on_packets=self.receive,
            on_unfit=self._on_unfit,
            on_peer_up=self._on_peer_up,
            on_peer_down=self._on_peer_down,
            on_log=lambda level, text: self._early_log.say(lambda: self.kernel.log(level, text)),
            defer=defer,
            gate=Gate(permits.may_act, lambda fence, packets: permits.hold_back(fence, "packets", packets)),
            times=LinkTimes(heartbeat_s=network.heartbeat_s),
            access=self.kernel.access,
            keys=self._keys,
            timebase=self.kernel.timebase,
            links=config.agent.links,
        )
        # A stream's name is never used again: its numbers are forgotten when this process ends.
        source = self.kernel.random_for("outbox") if virtual is not None else random.SystemRandom()
        secret = f"{source.getrandbits(128):032x}"
        self.outbox = Outbox(f"{self.name}/{journal.uuid}.{journal.boot}", self.name, secret)
        self.kernel.mission_packets_sent = self.mesh.mission_packets_sent
        self.kernel.links = self.mesh.links
        self.kernel.peer_clock = self.mesh.clocks.clock_of
        self.kernel.mission_changed = self.mesh.mission_changed
        for channel in config.channels:
            self.kernel.stream.open(channel)
        shared: dict[type[Service], dict[str, Any]] = {
            LogService: {"wanted": wanted_recordings(disk)},
            DeviceService: {"fences": FencesOfAgent(Fences(disk), self.records, self.ledgers)},
            NetworkService: {
                "mesh": self.mesh,
                "state": self.host_state,
                "records": self.records,
                "ledgers": self.ledgers,
                "began": self._take_early,
                "mdns": config.agent.mdns,
            },
            ClientService: {
                "mesh": self.mesh,
                "state": self.host_state,
                "records": self.records,
                "outbox": self.outbox,
                "catalogue": installed,
                "ledgers": self.ledgers,
                "births": BirthRule(config.agent.peers, config.agent.birth_wait_s, journal.former),
            },
        }
        self._composition = Composition(config, self._plugins, installed, shared, arguments, self.skipped)
        self._specs = self._composition.services()
        self.kernel.folders = self._composition.folders(self._specs)

    # Life ------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the port, and begin to start the services; `ready` is set when they run.

        Raises:
            PancakesError: its port is in use.
        """
        self._tend(Courier, COURIER, outbox=self.outbox, records=self.records, mesh=self.mesh)
        knows = {"records": self.records, "boots": self._boots, "state": self.host_state, "mesh": self.mesh}
        self._tend(Registrar, REGISTRAR, **knows)
        if self.kernel.virtual is None:
            self._tend(Importer, IMPORTER, installed=self._installed)
        try:
            self.mesh.start()  # after the actors, which peers ask at once
        except PancakesError:
            self._release()
            raise
        clock, comes_back = self.config.clock, self._boots.knows_any()
        root = self.kernel.spawn(
            Root,
            join(self.name, "kernel"),
            specs=self._specs,
            identity=self._identity,
            configuration=lambda: self._composition.configuration(self.records.all().values()),
            migrations=self.ledgers.plain,
            services_in_doubt=self.records.services_in_doubt,
            halts=self._halts,
            catalogue=self._installed,
            ready=self._become_ready,
            mission_start=MissionStart(self.kernel, self.mesh, clock.hold, clock.join_s, comes_back),
            shutdown=self._shut_down,
            exited=self._root_ended,
        )
        self._root = root

    def _tend(self, cls: type[Component], place: str, **arguments: Any) -> None:
        """Start an actor that belongs to no service, and start it again if it fails: it keeps no state that matters."""

        def ended(helper: Component, error: BaseException | None) -> None:
            self.kernel.stream.unsubscribe(helper.address)
            if error is not None and not self.stopping.is_set():
                text = f"{helper.address} failed and is started again: {describe(error, cls)}"
                self.kernel.log("error", text, traceback_of(error))
                self._tend(cls, place, **arguments)

        self.kernel.spawn(cls, join(self.name, place), exited=ended, **arguments)

    def _root_ended(self, root: Root, error: BaseException | None) -> None:
        """End the agent: without its root it takes no command any more, and no service is restarted."""
        self.kernel.stream.unsubscribe(root.address)
        if error is None and self.kernel.stopping:
            self._closed.set()
        if self._closed.is_set():
            return
        why = f"has failed: {describe(error)}" if error is not None else "was stopped"
        reason = f"{root.address}, which starts and watches the services, {why}"
        root.refuse_all(f"{self.name} ends: {reason}")
        self.kernel.stopping = True
        self._stop_for(reason)
        self.kernel.spawn(
            Closer,
            join(self.name, "kernel", "Closer"),
            services=[join(self.name, spec.name) for spec in self._specs],
            exited=lambda closer, failure: self._closed.set(),
        )

    def _become_ready(self) -> None:
        # Faults that were found earlier are logged only now, when the Log Service listens.
        for sentence in self.skipped:
            self.kernel.log("error", sentence)
        for sentence in self._remarks:
            self.kernel.log("warning", sentence)
        for task, why in self.resting.items():
            self.kernel.log("warning", f"{self.name}/{task} does not start: {why}")
        for why in self.mesh.near_only:
            self.kernel.log("warning", f"{self.name} is not reached from other machines: {why}. {ADVICE.capitalize()}")
        if over := self.insecure_over:
            text = f"{self.name} speaks over {over} without keys: nothing is encrypted, and no peer is checked"
            self.kernel.log("warning", text)
        self.ready.set()
        self._early_log.flush()

    def stop(self) -> None:
        """Stop everything in reverse order, and wait for that. Not from one of its own threads."""
        if self.stopping.is_set():
            return
        self.stopping.set()
        self.kernel.stopping = True
        closed = self._closed
        root = self._root
        if root is not None:
            tell(root, Close())
            if self.kernel.virtual is not None:
                until_s = self.kernel.virtual.clock.now() + CLOSE_S
                self.kernel.virtual.run_until(until_s, closed.is_set)
            elif not closed.wait(CLOSE_S):
                self.kernel.log("warning", f"{self.name} stops although some of its tasks have not ended")
        self._release()

    def _release(self) -> None:
        for place in (COURIER, REGISTRAR):
            actor = self.kernel.actor(place)
            if actor is not None:
                actor.stop()
        self.mesh.stop()
        self.store.close()
        if self.kernel.virtual is not None:
            self.kernel.virtual.settle()
        self.kernel.transport.close()
        self.kernel.stop()

    def crash(self) -> None:
        """End at once, as a kill does: no hook is called, and what waits for the disk is lost. In virtual time only."""
        if not isinstance(self.store, VirtualStore):
            raise RuntimeError(f"{self.name} does not run in virtual time")
        self.stopping.set()
        self.kernel.crash()
        self.store.crash()
        # The operating system closes its connections, and its peers see that.
        self.kernel.transport.close()

    def on_fatal(self, function: Callable[[str], None]) -> None:
        """Call `function` with the reason, in any thread, if the agent must stop; also if that is already so."""
        self._on_fatal = function
        if self.fatal:
            function(self.fatal)

    def on_shutdown(self, function: Callable[[], None]) -> None:
        """Call `function`, in any thread, if a `Shutdown` packet asks for this agent's end. Without one, refuse it."""
        self._on_shutdown = function

    def _shut_down(self, dry_run: bool) -> str:
        if self._on_shutdown is None:
            return "it does not run as a process of its own"
        if not dry_run:
            self._on_shutdown()
        return ""

    def _stop_for(self, reason: str) -> None:
        self.kernel.stopping = True
        self.fatal = self.fatal or reason
        self.kernel.log("error", reason)
        self._on_fatal(reason)

    def _journal_lost(self, reason: str) -> None:
        """End all tasks: another process could open the journal that is there now, and run them too. Any thread."""
        self.kernel.stopping = True
        root = self._root
        if root is not None:
            tell(root, Close())
        self._stop_for(
            f"{reason}; its tasks are ended, because an agent that is started now knows nothing of them."
            f" See that no other agent runs them, put the directory back if you can, and start {self.name} again"
        )

    def _identity(self) -> dict[str, Any]:
        return {
            "role": self.config.agent.role,
            "fleet": self.config.agent.fleet,
            "listen": self.mesh.listen,
            "neighbours": self.mesh.neighbours(),
            "peers": list(self.mesh.connected()),
            "insecure": self.insecure_over,
            "roster": self._roster_number(),
            "roster_fault": fault._asdict() if (fault := self.mesh.roster_fault) is not None else None,
            "config_file": self._describe_file(),
            "plugins": self._plugins.brings_tasks(),
            "journal_fault": self.store.fault(),
            "kept_of_peers": kept_of_peers(self.name, self.records.all().values()),
            "warnings": self._warnings.lines(self.kernel.host.now()),
            "mesh": {key: value for key, value in self.mesh.describe().items() if key not in _TOLD_ONCE},
            "halt": self._halts.describe(),
            "speed": self.config.clock.speed,
            # In virtual time many agents share one process.
            "process": describe_process(self.kernel.host.now() - self._born_s) if self.kernel.virtual is None else None,
            **self.host_state.describe(),
        }

    def _describe_file(self) -> dict[str, Any]:
        """Return whether the configuration on disk has changed since, and which of its files."""
        changed = [path for path, mark in self._config_files.items() if mark.changed()]
        return {"path": printable(next(iter(changed), self.config.path)), "changed": bool(changed)}

    def _roster(self) -> Roster | None:
        return self._keys.roster if self._keys is not None else None

    def _roster_number(self) -> int | None:
        """Return the number of the roster that this agent uses; 0: it has none; None: it has no keys."""
        roster = self._roster()
        return roster.number if roster is not None else 0 if self._keys is not None else None

    # The mesh's callbacks, in the transport's thread -----------------------------------------------------------

    def receive(self, peer: str, packets: Sequence[Packet], size: int) -> None:
        """Pass the packets of a peer to the stream; they had `size` bytes on the link. In the transport's thread."""
        if self._early is not None and any(packet.channel == SYSCTRL for packet in packets):
            with self._early_lock:
                if self._early is not None and len(self._early) < MOST_EARLY:
                    self._early.append((peer, packets, size))
                    return
        self.kernel.stream.inject_all(packets, partial(self._refused, peer), size)

    def _take_early(self) -> None:
        """Pass on what was asked of the agent between the first link and the start of its network."""
        while True:
            with self._early_lock:  # what comes meanwhile waits behind what came before
                early = self._early or []
                self._early = [] if early else None
            if not early:
                return
            for peer, packets, size in early:
                self.kernel.stream.inject_all(packets, partial(self._refused, peer), size)

    def _on_unfit(self, peer: str, packet: Packet, reason: str) -> None:
        self.kernel.stream.undelivered += 1
        self._refuse(peer, packet, Refusal("invalid", reason))

    def _refused(self, peer: str, packet: Packet, error: PancakesError) -> None:
        self._refuse(peer, packet, Refusal.of(error))

    def _refuse(self, peer: str, packet: Packet, refusal: Refusal) -> None:
        """Tell the sender of a command that it was refused. Any other packet is dropped and logged."""
        root = self._root
        if body_class(packet.type) in CONTROLS and root is not None:
            tell(root, NoRoom(packet, refusal))
            return
        now_s = self.kernel.host.now()
        # There may be thousands a second, and a line for each would be a load in itself.
        if now_s >= self._drop_logged_s + DROPS_REPORTED_EVERY_S:
            self._drop_logged_s = now_s
            self.kernel.log("warning", f"a packet of {peer} was dropped: {refusal.text}")

    def _on_peer_up(self, hello: Hello) -> None:
        self.kernel.unheard.met(hello.name)
        if hello.role == "client":
            # Each command at a terminal is a client: what it asks for is worth a line, its coming and going is not.
            self._clients.add(hello.name)
        else:
            self._early_log.say(lambda: self.kernel.say(Event("peer_up", {"peer": hello.name, "role": hello.role})))
        if self._halts.record.halted and hello.role != "client" and (root := self._root) is not None:
            tell(root, PeerMet(hello.name))
        if hello.role == "agent":
            self.kernel.tell(REGISTRAR, NeighbourUp(hello.name, Boot(hello.journal, hello.boot, hello.life)))

    def _on_peer_down(self, name: str, reason: str, asleep_s: float | None) -> None:
        if name in self._clients:
            self._clients.discard(name)
        else:
            self._early_log.say(lambda: self.kernel.say(Event("peer_down", {"peer": name, "reason": reason})))
        for spec in self._specs:
            if issubclass(spec.cls, NetworkService):
                self.kernel.tell(spec.name, PeerDown(name))
        self.kernel.tell(REGISTRAR, PeerDown(name))

    # Composition -----------------------------------------------------------------------------------------------

    def _open_journal(self) -> Journal:
        directory = state_dir_of(self.config)
        if directory is None:
            return MemoryJournal({}, str(uuid.uuid4()))
        return FileJournal(directory, agent=self.name)

    def _open_transport(self) -> Transport:
        agent, network = self.config.agent, network_settings(self.config)
        self._keys = keys = keys_for(self.config, network, self._plugins)
        if keys is not None and (fault := keys.fault_of(keys.own)):
            self.skipped.append(f"no agent of {agent.fleet} believes this one any more: {fault}")
        if keys is not None and not can_check():
            self.skipped.append(f"this agent goes on to believe members that are revoked: {UNCHECKED}")
        self.insecure_over = insecure_over(agent, keys is not None, self._plugins)
        settings = transport_settings(agent, network)
        return SocketTransport(self.kernel.host, self.name, self._plugins, settings, keys, network.insecure)

    def _resting(self) -> dict[str, str]:
        services = {task.name: task.service for task in self.config.tasks.values() if task.start}
        found = resting(self.name, services, self.records.all())
        return {f"{services[name]}/{name}": why for name, why in found.items()}
