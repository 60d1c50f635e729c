"""`pancakes drive`: drive a robot by hand, from the keyboard or a gamepad (docs/drive.md)."""

from __future__ import annotations

import os
import secrets
import select
import signal
import sys
import termios
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import click

from pancakes.client import Client
from pancakes.control import Drive, EndDrive
from pancakes.errors import ControlRefusedError, NoAnswerError, PancakesError, UnreachableError
from pancakes.tools.cli.agent_requests import request, request_result
from pancakes.tools.cli.hand_input import KEYS, STILL, Gamepad, Keyboard, Share
from pancakes.tools.cli.options import Ask, FiniteRange, asks_agents_for, dry_run_option, the_agent
from pancakes.tools.cli.output import show_text
from pancakes.tools.cli.streaming import event_at

GAMEPAD: Final = "/dev/input/js0"
SEND_S: Final = 0.1
"""The time between two commands; less if the robot would stop before."""
ANSWER_S: Final = 1.0
"""How long the answer to a command is awaited: the robot has stopped by then."""
SILENT_S: Final = 5.0
"""After this time without an answer the robot has ended the drive."""
_READ: Final = 4096
_CLEAR: Final = "\r\x1b[K"


@click.command()
@the_agent
@click.option("--device", metavar="NAME", default="motors", show_default=True, help="The actuator to drive.")
@click.option(
    "--speed",
    "speed_mps",
    metavar="M/S",
    type=FiniteRange(min=0, min_open=True),
    default=0.2,
    show_default=True,
    help="The speed of a key, or of the stick at its end.",
)
@click.option(
    "--turn",
    "turn_radps",
    metavar="RAD/S",
    type=FiniteRange(min=0, min_open=True),
    default=1.0,
    show_default=True,
    help="The turning rate of a key, or of the stick at its end.",
)
@click.option(
    "--gamepad",
    metavar="[PATH]",
    is_flag=False,
    flag_value=GAMEPAD,
    help=f"Use a gamepad, a joystick device of Linux, too; {GAMEPAD} without PATH.",
)
@click.option("--take", is_flag=True, help="Take over from somebody else who drives.")
@dry_run_option
@asks_agents_for(3.0, formats=False)
def drive(
    agent: str,
    device: str,
    speed_mps: float,
    turn_radps: float,
    gamepad: str | None,
    take: bool,
    dry_run: bool,
    ask: Ask,
) -> None:
    """Drive a robot by hand, with W A S D or the arrow keys, or with a gamepad.

    While you drive, the task that commanded the actuator before is paused, and all other commands to it are refused. It
    goes on by itself at the end, also if this program dies or the link is lost. The robot stops if no command reaches
    it for the `drive_stop_s` of its device. Filters and halts count for you too.

    Let go of all keys to stop. Space or any other key stops at once; X or Ctrl-C ends. If somebody else drives, you are
    refused, unless you say --take.

    The exit code is 0 if you end it, 1 if the robot refuses or somebody takes over, and 3 if it does not answer.

    \b
    Example:
        pancakes drive agent1
        pancakes drive agent1 --gamepad --speed 0.5
    """
    hands = _Hands(gamepad)
    if not (dry_run or hands.sources()):
        raise click.UsageError("standard input is no terminal with a keyboard: use one, or --gamepad")
    with ask.client() as client:
        body = Drive(device, secrets.token_hex(8), begin=True, take=take, dry_run=dry_run)
        if dry_run:
            request(client, agent, body)
            show_text(f"{device} of {agent} can be driven")
            return
        ended = event_at(signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        with hands:
            begun = request_result(client, agent, body)
            try:
                _tell_begin(agent, begun)
                send_commands(client, agent, body, begun, hands, (speed_mps, turn_radps), ended.is_set)
            finally:
                _end(client, agent, body, begun)


def _tell_begin(agent: str, begun: dict[str, Any]) -> None:
    waits = f" {begun['paused']} waits." if begun["paused"] else ""
    show_text(f"You drive {begun['device']} of {agent}.{waits}")
    show_text(KEYS)


def send_commands(
    client: Client,
    agent: str,
    first: Drive,
    begun: dict[str, Any],
    hands: _Hands,
    most: tuple[float, float],
    ended: Callable[[], bool],
) -> None:
    """Send what the hands say, until the person or the robot ends it.

    Raises:
        PancakesError: the robot refuses, or does not answer any more.
    """
    period_s = min(SEND_S, begun["stop_after_s"] / 4)
    answered_s = due_s = client.now()
    moving = unanswered = False
    while not (ended() or hands.quits):
        share, factor = hands.read(due_s - client.now(), client.now)
        now_s = client.now()
        stops = moving and share == STILL
        if now_s < due_s and not stops:
            continue
        due_s, moving = now_s + period_s, share != STILL
        if unanswered:
            # The link may deliver all that were sent meanwhile, one after the other, when nobody wants them any more.
            share = STILL
        velocity = Drive(first.target, first.id, share.forward * most[0] * factor, share.turn * most[1] * factor)
        try:
            reply = client.request(agent, velocity, ANSWER_S)
        except (NoAnswerError, UnreachableError) as error:
            if client.now() - answered_s > SILENT_S:
                raise NoAnswerError(f"{error}. {agent} has stopped by itself, and the drive is over") from None
            unanswered = True
            _show(f"{agent} does not answer: it stops by itself")
            hands.wait(period_s)
            continue
        if not reply.ok:
            raise ControlRefusedError.of(reply.refusal)
        answered_s, unanswered = client.now(), False
        _show(_line(velocity, reply.result))


def _line(velocity: Drive, told: dict[str, Any]) -> str:
    filters = [f"{it['filter']} {it['doing']}: {it['why']}" for it in told["filters"] if it["why"]]
    text = f"{velocity.v_mps:+.2f} m/s  {velocity.omega_radps:+.2f} rad/s"
    return "  ".join((text, *filters))


def _show(text: str) -> None:
    """Show a line in the place of the one before."""
    if sys.stdout.isatty():
        show_text(text, nl=False, head=_CLEAR)
        sys.stdout.flush()


def _end(client: Client, agent: str, first: Drive, begun: dict[str, Any]) -> None:
    """End the drive, if it lasts: the robot would end it by itself, some seconds later."""
    _show("")
    try:
        reply = client.request(agent, EndDrive(first.target, first.id), ANSWER_S)
    except PancakesError:
        return
    if reply.ok:
        goes_on = f" {begun['paused']} continues." if begun["paused"] else ""
        show_text(f"{begun['device']} of {agent} stopped.{goes_on}")


class _Hands:
    """The keyboard of the terminal and the gamepad, as far as there are any.

    While it is entered, the terminal shows no key, and gives each at once; whatever ends that, it is as before.
    """

    def __init__(self, gamepad: str | None) -> None:
        self._keyboard = Keyboard() if sys.stdin is not None and sys.stdin.isatty() else None
        self._path = gamepad
        self._gamepad: Gamepad | None = None
        self._device = -1
        self._cooked: list[Any] | None = None

    def sources(self) -> bool:
        """Return whether a person can say anything."""
        return self._keyboard is not None or self._path is not None

    @property
    def quits(self) -> bool:
        """Whether the person has asked for the end."""
        return self._keyboard is not None and self._keyboard.quits

    def __enter__(self) -> _Hands:
        if self._path is not None:
            self._gamepad = Gamepad()
            try:
                self._device = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK)
            except OSError as error:
                raise PancakesError(f"the gamepad {self._path} cannot be read: {error.strerror}") from None
        if self._keyboard is not None:
            self._cooked = _raw(sys.stdin.fileno())
        return self

    def __exit__(self, *error: object) -> None:
        if self._device >= 0:
            os.close(self._device)
        if self._cooked is not None:
            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSAFLUSH, self._cooked)

    def wait(self, for_s: float) -> None:
        """Wait for a time in seconds, and leave what is typed meanwhile."""
        select.select([], [], [], for_s)

    def read(self, for_s: float, now: Callable[[], float]) -> tuple[Share, float]:
        """Wait until the hands say something, at most for a time in seconds; return what they say, and the factor.

        Raises:
            PancakesError: the gamepad is gone.
        """
        keys = sys.stdin.fileno() if self._keyboard is not None else -1
        ready, _, _ = select.select([it for it in (keys, self._device) if it >= 0], [], [], max(0.0, for_s))
        if self._keyboard is not None and keys in ready:
            data, stops = _typed(keys), self._keyboard.stops
            self._keyboard.take(data, now())
            self._keyboard.quits |= not data  # the terminal is gone
            if self._gamepad is not None and self._keyboard.stops > stops:
                self._gamepad.stop()
        if self._gamepad is not None and self._device in ready:
            self._gamepad.take(self._events())
        share = self._keyboard.share(now()) if self._keyboard is not None else STILL
        if share == STILL and self._gamepad is not None:
            share = self._gamepad.share()
        return share, self._keyboard.factor if self._keyboard is not None else 1.0

    def _events(self) -> bytes:
        try:
            data = os.read(self._device, _READ)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PancakesError(f"the gamepad {self._path} is gone: {error.strerror}") from None
        if not data:
            raise PancakesError(f"the gamepad {self._path} is gone")
        return data


def _typed(terminal: int) -> bytes:
    """Return what was typed; nothing: the terminal is gone."""
    try:
        return os.read(terminal, _READ)
    except OSError:
        return b""


def _raw(terminal: int) -> list[Any]:
    """Have a terminal give each key at once and show none; return how it was. Ctrl-C still interrupts.

    Ctrl-Z, Ctrl-backslash and Ctrl-S are keys as all others: none may leave the terminal as it is now, or keep what is
    shown from it and so this program from sending.
    """
    before = termios.tcgetattr(terminal)
    now = termios.tcgetattr(terminal)
    now[3] &= ~(termios.ICANON | termios.ECHO)
    now[6][termios.VMIN], now[6][termios.VTIME] = 1, 0
    now[6][termios.VSUSP] = now[6][termios.VQUIT] = os.fpathconf(terminal, "PC_VDISABLE").to_bytes(1, "little")
    now[0] &= ~termios.IXON
    termios.tcsetattr(terminal, termios.TCSADRAIN, now)
    return before
