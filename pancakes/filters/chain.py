"""Run the filters of one actuator: in their order, with an account of what each has done.

`FilterChain` belongs to the device's actor. `FilterAccounts` is its account, which any thread may read.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, make_dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, Literal

import msgspec

from pancakes.devices.validation import fault_of_command
from pancakes.errors import PancakesError, describe
from pancakes.events import Log
from pancakes.filters.filter import Changed, Filter, Held
from pancakes.kernel.actor import ActorCore
from pancakes.packet import Packet, is_of_type

SETTING: Final = "filters"
"""The key of a device's settings under which those of its filters are, by name."""
QUIET_S: Final = 1.0
"""A filter that has let all pass for this time, in mission time, is reported to pass again."""

Doing = Literal["passes", "changes", "holds"]


class FilterSpec(msgspec.Struct, frozen=True):
    """A filter as data, from `[filter.NAME]`.

    Attributes:
        name: its name.
        cls: its class.
        type: the name of its entry point.
        settings: its settings, as plain values.
    """

    name: str
    cls: type[Filter]
    type: str
    settings: Mapping[str, Any]


@lru_cache(maxsize=256)
def settings_with_filters(cls: type, filters: tuple[tuple[str, type], ...]) -> type:
    """Return a driver's `Settings` with those of its filters under `filters`, by name; without filters, as they are.

    Args:
        cls: the driver's `Settings`.
        filters: the name of each filter and its `Settings`.
    """
    if not filters:
        return cls
    inner = make_dataclass("Filters", [(name, settings) for name, settings in filters])
    inner.__doc__ = "The settings of the filters, by name."
    inner.__module__ = cls.__module__
    made: type
    if is_dataclass(cls):
        frozen: bool = cls.__dataclass_params__.frozen  # type: ignore[attr-defined]
        own = [(SETTING, inner, field(kw_only=True))]
        made = make_dataclass(cls.__name__, own, bases=(cls,), frozen=frozen)
    else:
        made = msgspec.defstruct(cls.__name__, [(SETTING, inner)], bases=(cls,), kw_only=True)
    made.__doc__, made.__module__ = cls.__doc__, cls.__module__
    return made


@dataclass
class _Account:
    """What one filter has done since the device was opened."""

    name: str
    type: str
    passed: int = 0
    changed: int = 0
    held: int = 0
    doing: Doing = "passes"
    why: str = ""
    since_s: float = 0.0
    last_s: float = 0.0  # when it last changed or held something


class FilterAccounts:
    """What the filters of one device have done. Any thread may read it; the device's actor writes.

    Args:
        filters: the filters.
    """

    def __init__(self, filters: Sequence[FilterSpec]) -> None:
        self._lock = threading.Lock()
        self._accounts = [_Account(it.name, it.type) for it in filters]

    def note(self, index: int, doing: Doing, why: str, now_s: float) -> bool:
        """Take note of what a filter did with a command; return whether people should hear of it."""
        account = self._accounts[index]
        with self._lock:
            if doing == "passes":
                account.passed += 1
                if account.doing == "passes" or now_s - account.last_s < QUIET_S:
                    return False
                why = ""
            else:
                account.last_s = now_s
                if doing == "changes":
                    account.changed += 1
                else:
                    account.held += 1
                if (account.doing, account.why) == (doing, why):
                    return False
            account.doing, account.why, account.since_s = doing, why, now_s
            return True

    def describe(self, now_s: float) -> list[dict[str, Any]]:
        """Return what each filter has done, as plain values.

        Args:
            now_s: mission time.

        Returns:
            For each, in their order: `filter`, `type`, how many commands it has `passed`, `changed` and `held`, what it
            is `doing` now (`passes`, `changes` or `holds`), `why`, and for how long already (`for_s`).
        """
        with self._lock:
            return [
                {
                    "filter": it.name,
                    "type": it.type,
                    "passed": it.passed,
                    "changed": it.changed,
                    "held": it.held,
                    "doing": it.doing,
                    "why": it.why,
                    "for_s": max(0.0, now_s - it.since_s),
                }
                for it in self._accounts
            ]


class _Context:
    """What a filter gets of its agent: see `FilterContext`."""

    def __init__(self, actor: ActorCore, name: str, subscribe: Callable[..., None], kept: dict[str, Any]) -> None:
        self._actor = actor
        self.kept = kept
        self.agent = actor.agent
        self.device = actor.name
        self.name = name
        self.now = actor.now
        self.subscribe = subscribe

    def publish(self, channel: str, body: Any, to: str = "") -> None:
        actor, fence = self._actor, self._actor.fence
        actor.fence = None  # it speaks for the device, not for the task that commands it
        try:
            actor.publish(channel, body, to)
        except PancakesError:
            actor.kernel.stream.undelivered += 1
        finally:
            actor.fence = fence

    def after(self, delay_s: float, function: Callable[[], None]) -> None:
        self._actor.after(delay_s, function)

    def published_s(self, packet: Packet) -> float:
        now_s = self._actor.now()
        known = self._actor.kernel.local_time(packet)
        # The bound is not subtracted: in the first seconds of a link it is wide, and all poses would count as old.
        return min(now_s, known.time_s) if known is not None else now_s

    @cached_property
    def log(self) -> Log:
        actor, head = self._actor, f"{self.device}, filter {self.name}: "
        return Log(lambda level, text, traceback: actor.log(level, head + text, traceback))


class FilterChain:
    """The filters of one actuator, in the order in which commands pass them. In the device's actor.

    Args:
        actor: the device's actor.
        device_type: the type of the actuator.
        filters: the filters.
        settings: the device's settings, which have those of the filters.
        kept: what filters keep while the device is restarted, by device and filter.

    Attributes:
        accounts: what they have done.
    """

    def __init__(
        self,
        actor: ActorCore,
        device_type: str,
        filters: Sequence[FilterSpec],
        settings: Any,
        kept: dict[tuple[str, str], dict[str, Any]],
    ) -> None:
        self._actor = actor
        self._type = device_type
        self._specs = filters
        self._handlers: dict[tuple[str, type], list[Callable[[Packet], None]]] = {}
        self._told: dict[str, str] = {}  # the errors that were logged, by filter
        self.accounts = FilterAccounts(filters)
        self._filters = [
            spec.cls(
                _Context(actor, spec.name, self._subscribe, kept.setdefault((actor.name, spec.name), {})),
                getattr(getattr(settings, SETTING), spec.name),
            )
            for spec in filters
        ]

    @property
    def check_s(self) -> float | None:
        """How often the newest command has to pass again, in mission seconds; None: it need not."""
        fastest_hz = max((float(it.check_hz) for it in self._filters), default=0.0)
        return 1.0 / fastest_hz if fastest_hz > 0.0 else None

    def open(self) -> None:
        """Begin all of them."""
        for it in self._filters:
            it.open()

    def close(self) -> None:
        """End all of them; an error of one does not keep the others."""
        for spec, it in zip(self._specs, self._filters, strict=True):
            try:
                it.close()
            except Exception as error:  # its author's code
                self._tell(spec, f"failed in close: {describe(error, spec.cls)}")

    def take_settings(self, settings: Any) -> None:
        """Give each filter its part of new settings; if one refuses, all keep the former.

        Raises:
            PancakesError, ValueError: a filter refuses them.
        """
        former = [it.settings for it in self._filters]
        changed = [
            (it, new)
            for spec, it in zip(self._specs, self._filters, strict=True)
            if (new := getattr(getattr(settings, SETTING), spec.name)) != it.settings
        ]
        try:
            for it, new in changed:
                it.settings = new
                it.on_settings()
        except (PancakesError, ValueError):
            for it, old in zip(self._filters, former, strict=True):
                if it.settings is not old:
                    it.settings = old
                    it.on_settings()
            raise

    def on_hold(self) -> None:
        """The actuator went to its safe hold."""
        for spec, it in zip(self._specs, self._filters, strict=True):
            try:
                it.on_hold()
            except Exception as error:  # its author's code
                self._tell(spec, f"failed in on_hold: {describe(error, spec.cls)}")

    def apply(self, command: Any, ttl_s: float, source: str) -> Any:
        """Return the command that may be carried out in place of one, or `Held`."""
        now_s = self._actor.now()
        for index, (spec, it) in enumerate(zip(self._specs, self._filters, strict=True)):
            try:
                found = it.apply(command, ttl_s, source)
                doing, command, why = self._judged(command, found)
            except Exception as error:  # its author's code: nothing passes that it has not seen
                failed = describe(error, spec.cls)
                self._tell(spec, f"failed, so nothing passes: {failed}")
                doing, command, why = "holds", None, f"failed: {failed}"
            if self.accounts.note(index, doing, why, now_s):
                fields = {"device": self._actor.name, "filter": spec.name, "doing": doing, "reason": why}
                self._actor.event("command_filtered", by=source, **fields)
            if doing == "holds":
                return Held(f"filter {spec.name}: {why}")
        return command

    def _judged(self, command: Any, found: Any) -> tuple[Doing, Any, str]:
        if found is command:
            return "passes", command, ""
        if isinstance(found, Held):
            return "holds", None, found.why
        other, why = (found.command, found.why) if isinstance(found, Changed) else (found, "")
        if not is_of_type(other, self._type):
            raise TypeError(f"it returned a {type(other).__name__}, which is no command of the type {self._type!r}")
        if fault := fault_of_command(other):
            raise ValueError(f"its command is none: {fault}")
        return ("passes", other, "") if other == command else ("changes", other, why)

    def _tell(self, spec: FilterSpec, text: str) -> None:
        if self._told.get(spec.name) != text:  # at 20 commands a second it would drown everything else
            self._told[spec.name] = text
            self._actor.log("error", f"{self._actor.name}: the filter {spec.name} {text}")

    def _subscribe(self, channel: str, body: type, handler: Callable[[Packet], None]) -> None:
        handlers = self._handlers.setdefault((channel, body), [])
        handlers.append(handler)
        if len(handlers) == 1:
            self._actor.subscribe(channel, body, lambda packet: self._heard(handlers, packet))

    def _heard(self, handlers: Sequence[Callable[[Packet], None]], packet: Packet) -> None:
        for handler in handlers:
            handler(packet)
