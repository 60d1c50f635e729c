"""The serial port to a Khepera III, and the thread that speaks on it."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable
from typing import Any, Final

from pancakes.devices.driver import DeviceContext, why_not_opened
from pancakes_pi.khepera_lines import END, LONGEST, STAND, VERSION, NoAnswerError, numbers_in, speeds

FIRST_PAUSE_S: Final = 0.2
LONGEST_PAUSE_S: Final = 5.0
"""How long, in host time, a port that is not there is left alone before it is tried again."""
ANSWER_S: Final = 0.3
"""So long an answer may take."""
NOISE: Final = 20
"""How many other lines are skipped, at most, while an answer is awaited."""
SILENT: Final = 5
"""A robot that does not answer so often in a row is taken to be gone."""

Taker = Callable[[list[list[int]]], None]
"""Takes the numbers of each answer. Called in the port's thread."""
Say = Callable[[str, str], None]


class KheperaPort:
    """Speaks with a robot, for all of its devices. Any thread.

    Of commands to the wheels the newest counts; of questions each device has one under way at a time. What is not
    there, or goes away, is tried again until it is there; the wheels are told to stand first then.

    Args:
        port: the port's file, such as `/dev/ttyUSB0`.
        baud: bits a second.
        say: says lines on `log`.
    """

    def __init__(self, port: str, baud: int, say: Say) -> None:
        self._port = port
        self._baud = baud
        self._say = say
        self._news = threading.Condition()
        self._speeds: str | None = None
        self._questions: dict[str, tuple[tuple[str, ...], Taker]] = {}
        self._ended = False
        self._connected = False
        # What follows is the thread's own.
        self._complained = False
        self._noisy = False
        self._silent = 0
        self._pause_s = FIRST_PAUSE_S
        self._thread = threading.Thread(target=self._run, name=f"khepera-{port}", daemon=True)
        # A process that ends waits for the last word: the wheels are to stand.
        atexit.register(self._outlast)
        self._thread.start()

    def drive(self, left: int, right: int) -> bool:
        """Has the wheels turn; returns whether there is a robot."""
        with self._news:
            self._speeds = speeds(left, right)
            self._news.notify()
            return self._connected

    def ask(self, device: str, questions: tuple[str, ...], taker: Taker) -> None:
        """Asks the robot, and gives the answers to `taker` where all have come."""
        with self._news:
            if self._connected:
                self._questions.setdefault(device, (questions, taker))
                self._news.notify()

    def forget(self, device: str) -> None:
        """A device asks nothing more."""
        with self._news:
            self._questions.pop(device, None)

    def close(self) -> None:
        """Tells the wheels to stand, and ends. Does not wait for that."""
        with self._news:
            self._ended = True
            self._speeds = STAND
            self._news.notify()

    def _outlast(self) -> None:
        if self._connected:
            self._thread.join(ANSWER_S)

    # The thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._is_over():
            try:
                self._attend()
            except OSError as error:  # pyserial's errors are of this kind too
                self._lost(why_not_opened(error))
            with self._news:
                self._news.wait_for(lambda: self._ended, self._pause_s)
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        atexit.unregister(self._outlast)

    def _is_over(self) -> bool:
        with self._news:
            return self._ended

    def _attend(self) -> None:
        import serial

        with serial.Serial(self._port, self._baud, timeout=ANSWER_S, write_timeout=ANSWER_S, exclusive=True) as port:
            port.reset_input_buffer()
            port.write(END)  # ends what a predecessor may have begun
            version = self._transact(port, VERSION)
            if version is None:
                raise OSError("nothing answers like a Khepera III")
            self._transact(port, STAND)
            self._found(version)
            while self._take_turn(port):
                pass

    def _found(self, version: list[int]) -> None:
        self._complained = False
        self._silent = 0
        self._pause_s = FIRST_PAUSE_S
        with self._news:
            self._speeds = None
            self._connected = True
        self._say("info", f"speaks with a Khepera III (firmware {'.'.join(map(str, version))}) on {self._port}")

    def _take_turn(self, port: Any) -> bool:
        """Wait for the next thing to say, and say it; return whether there may be more."""
        with self._news:
            self._news.wait_for(lambda: self._ended or self._speeds or self._questions, 1.0)
            drive, self._speeds = self._speeds, None
            device = next(iter(self._questions), None)
            asked = self._questions[device] if device is not None else None
            over = self._ended
        if drive is None and asked is None and not over:
            drive = VERSION  # a cable that was pulled out is noticed also while there is nothing to say
        if drive is not None:
            self._transact(port, drive)
        if asked is not None and device is not None and not over:
            answers = [self._transact(port, question) for question in asked[0]]
            with self._news:
                wanted = self._questions.pop(device, None) is not None
            if wanted and None not in answers:
                asked[1]([answer for answer in answers if answer is not None])
        return not over

    def _transact(self, port: Any, command: str) -> list[int] | None:
        """Says a command, and returns the numbers of the answer; None where none came."""
        try:
            port.write(command.encode() + END)
            for _ in range(NOISE):
                line = port.read_until(b"\n", LONGEST)
                if not line:
                    break
                try:
                    numbers = numbers_in(line, command)
                except NoAnswerError as error:
                    self._hear_noise(line, error)
                    continue
                self._silent = 0
                return numbers
        except OSError:  # pyserial says this in many ways
            raise OSError("nothing is at its other end any more") from None
        self._silent += 1
        if self._silent >= SILENT:
            raise OSError("the robot does not answer")
        return None

    def _hear_noise(self, line: bytes, error: NoAnswerError) -> None:
        if line.strip() and not self._noisy:
            self._noisy = True
            self._say("warning", f"{self._port} is noisy: {error}; more of that is read past in silence")

    def _lost(self, reason: str) -> None:
        with self._news:
            was, self._connected = self._connected, False
            self._questions.clear()
            if self._ended:
                return
        if was:
            self._say("error", f"{self._port} is gone ({reason}); trying until it is there again")
        elif not self._complained:
            self._say("warning", f"{self._port} cannot be used ({reason}); trying until it can")
        self._complained = True


def khepera_port(context: DeviceContext, port: str, baud: int) -> KheperaPort:
    """Returns the port that all devices of this agent on the same robot share."""
    return context.shared(f"khepera {port}", lambda: KheperaPort(port, baud, context.log))
