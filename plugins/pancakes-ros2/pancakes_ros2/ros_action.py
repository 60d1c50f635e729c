"""An action server of a robot as a device (`ros2.action`), such as Nav2's NavigateToPose."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Final

from msgspec import Meta

from pancakes.devices.driver import Actuator
from pancakes.errors import PancakesError
from pancakes.packet import SYSTEM
from pancakes.util import codecs
from pancakes.util.clock import MonotonicClock
from pancakes_ros2.goal_packets import GOAL, Goal, GoalStatus
from pancakes_ros2.installation import checked_type
from pancakes_ros2.keeper_pipe import (
    MOST_BACKLOG,
    Again,
    Alive,
    Command,
    Failure,
    Hold,
    PipeWriter,
    Ready,
    Setup,
    Status,
    Warned,
    read_all,
)
from pancakes_ros2.node_table import check_possible, fail

Hz = Annotated[float, Meta(gt=0)]
KEEPER: Final = ("-P", "-m", "pancakes_ros2.goal_keeper")  # no module of the folder that the agent is in
STARTS_WITHIN_S: Final = 20.0
FLUSH_S: Final = 0.02
"""What did not fit into the pipe is written on after so long."""
LOOK_S: Final = 1.0
MOST_LOOKS: Final = 5
"""A keeper that has said nothing at this many looks in a row, and for as many seconds, hangs."""


class RosAction(Actuator):
    """An action server, which works on the goal that its holder commands, and only as long as it does.

    Its client is a process of its own, the goal keeper, which cancels the goal also if this process is killed.
    """

    type = GOAL
    blocking = True  # it starts a process

    @dataclass
    class Settings:
        """Which action.

        Attributes:
            action: its type, such as `nav2_msgs/action/NavigateToPose`; any that is installed.
            name: its name, such as `navigate_to_pose`; one that does not begin with a slash is below `/AGENT`.
            feedback_hz: how many feedback messages a second are passed on at most.
        """

        action: str
        name: str
        feedback_hz: Hz = 10.0

        def __post_init__(self) -> None:
            self.action = checked_type(self.action, "action")
            if not self.name.strip("/"):
                raise ValueError("the action has no name")

    settings: Settings
    _process: subprocess.Popen[bytes] | None = None
    _out: PipeWriter | None = None
    _command = b""
    _flushing = False
    _heard = True  # set by the thread that listens
    _heard_s = 0.0
    _silent_looks = 0

    def open(self) -> None:
        context, settings = self.context, self.settings
        check_possible(context.agent, context.virtual)
        self._now = MonotonicClock().now
        self._came: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._process = process = subprocess.Popen(
            [sys.executable, *KEEPER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # what is sent to the agent's terminal or group is not for it
        )
        assert process.stdin is not None
        self._out = PipeWriter(process.stdin.fileno())
        threading.Thread(target=self._listen, args=(process,), name=f"goals-{context.device}", daemon=True).start()
        self._out.put(Setup(context.agent, context.device, settings.action, settings.name, settings.feedback_hz))
        # A device that runs can be commanded: no task comes to a robot that would let it wait.
        try:
            why = self._came.get(timeout=STARTS_WITHIN_S)
        except queue.Empty:
            process.kill()
            why = f"the goal keeper of {settings.name} has not started within {STARTS_WITHIN_S:g} s"
        if why:
            raise PancakesError(why)
        self._look(process)

    def close(self) -> None:
        process, self._process, self._out = self._process, None, None
        if process is not None and process.stdin is not None:
            process.stdin.close()  # it ends when no goal is left

    def write(self, command: Goal, ttl_s: float, source: str) -> None:
        until_s = self._now() + ttl_s
        try:
            encoded = codecs.encode((source, command.number, command.fields))
        except codecs.UNENCODABLE as error:
            self._refuse(command, source, f"it cannot be told to the goal keeper: {error}")
            return
        if len(encoded) > MOST_BACKLOG:
            self._refuse(command, source, f"it has {len(encoded)} bytes, and at most {MOST_BACKLOG} are taken")
            return
        known = encoded == self._command
        if not self._put(Again(until_s) if known else Command(source, command.number, command.fields, until_s)):
            raise PancakesError(f"the goal keeper of {self.settings.name} does not read what it is told")
        self._command = encoded

    def _refuse(self, command: Goal, source: str, why: str) -> None:
        self._put(Hold())  # the goal before is not wanted any more either
        self._tell(Status(source, command.number, "refused", why))

    def watchdog_s(self, hold_after_s: float) -> float:
        """The goal keeper counts each command's time to live, and outlives this process."""
        return hold_after_s

    def safe_stop(self) -> None:
        self._put(Hold())

    def _put(self, order: Command | Again | Hold) -> bool:
        out = self._out
        try:
            taken = out is None or out.put(order)
        except OSError:
            return True  # that it has ended is heard from the thread that listens
        self._flush_later()
        return taken

    def _flush_later(self) -> None:
        if self._out is not None and self._out.waits and not self._flushing:
            self._flushing = True
            self.context.after(FLUSH_S, self._flush)

    def _flush(self) -> None:
        self._flushing = False
        try:
            if self._out is not None:
                self._out.flush()
        except OSError:
            return
        self._flush_later()

    def _look(self, process: subprocess.Popen[bytes]) -> None:
        """Kills a keeper that stands still, because it cancels nothing: the next one does."""
        if self._process is not process:
            return
        # Looks count as well, so that an agent that stood still itself does not blame its keeper.
        if self._heard:
            self._heard, self._heard_s, self._silent_looks = False, self._now(), 0
        else:
            self._silent_looks += 1
        if self._silent_looks >= MOST_LOOKS and self._now() - self._heard_s >= MOST_LOOKS * LOOK_S:
            self.context.log.warning(f"the goal keeper of {self.settings.name} stands still, and is killed")
            process.kill()
        else:
            self.context.after(LOOK_S, partial(self._look, process))

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        """Take what the keeper says, in a thread of its own, until it has ended."""
        assert process.stdout is not None
        why, runs = "", False
        with process.stdout as stream:
            for said in read_all(stream, Ready | Alive | Status | Warned | Failure):
                self._heard = True
                if isinstance(said, Alive):
                    continue
                if isinstance(said, Ready):
                    runs = True
                    self._came.put("")
                elif isinstance(said, Failure):
                    why = said.text
                elif isinstance(said, Warned):
                    self.context.log.warning(said.text)
                else:
                    self.context.call(partial(self._tell, said))
        code = process.wait()
        why = why or f"the goal keeper of {self.settings.name} has ended with exit code {code}"
        if not runs:
            self._came.put(why)
        elif self._process is process:
            self.context.call(partial(self._fail, process, why))

    def _tell(self, said: Status) -> None:
        status = GoalStatus(
            self.context.device, said.task, said.number, said.state, said.text, said.feedback, said.result
        )
        self.context.send(SYSTEM, status, "")

    def _fail(self, process: subprocess.Popen[bytes], why: str) -> None:
        """Fails the device, which its service then restarts, unless it was closed meanwhile."""
        if self._process is process:
            fail(why)
