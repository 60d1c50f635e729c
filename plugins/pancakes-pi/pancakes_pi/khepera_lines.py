"""The lines that a Khepera III takes and says on its serial port. Pure.

Source: K-Team, Khepera III user manual 3.5 (2013), appendix "Communication protocol", and K-Team's kh3server. A command
is a capital letter with parameters; the answer begins with the small one. A parameter of 32 bits has an `l` before it.
"""

from __future__ import annotations

from typing import Final

from pancakes.devices.validation import level_of
from pancakes.errors import PancakesError
from pancakes.util.text import whole_number_in

END: Final = b"\r"
VERSION: Final = "B"
PROXIMITY: Final = "N"
STAND: Final = "D,l0,l0"
VOLTAGE: Final = "V,0"
CHARGE: Final = "V,5"
MOST_SPEED: Final = 48_000
RING: Final = 9
"""The infrared sensors of the ring; two more look at the ground."""
SONARS: Final = 5
LONGEST: Final = 256
"""No line of the protocol is longer."""


class NoAnswerError(ValueError):
    """A line is no answer to what was asked."""


def speeds(left: int, right: int) -> str:
    """Returns the command that has the wheels turn, in the controller's units."""
    left, right = (min(MOST_SPEED, max(-MOST_SPEED, speed)) for speed in (left, right))
    return f"D,l{left},l{right}"


def sonar(number: int) -> str:
    """Returns the command that asks a sonar, from 1 (left) to 5 (right)."""
    return f"G,{number}"


def numbers_in(line: bytes, command: str) -> list[int]:
    """Returns the numbers of an answer.

    Raises:
        NoAnswerError: the line is none to this command.
    """
    try:
        head, *rest = line.decode("ascii").strip("\r\n").split(",")
        if head != command[0].lower():
            raise NoAnswerError
        return [whole_number_in(number) for number in rest]
    except ValueError:  # UnicodeDecodeError too
        raise NoAnswerError(f"{line[:40]!r} is no answer to {command}") from None


def ring_in(numbers: list[int]) -> tuple[int, ...]:
    """Returns what the infrared sensors of the ring say, back left first, then round by the front, the back one last.

    Raises:
        NoAnswerError: they are not 11 and a time.
    """
    if len(numbers) < RING + 2:
        raise NoAnswerError(f"the robot told {len(numbers)} infrared sensors, not {RING + 2}")
    return tuple(numbers[:RING])


def echo_in(numbers: list[int]) -> float | None:
    """Returns the distance of the nearest echo, in metres; None where there was none. Raises NoAnswerError."""
    if not numbers:
        raise NoAnswerError("the robot told no number of echoes")
    echoes = numbers[1 : 1 + 3 * numbers[0] : 3]
    return min(echoes) / 100.0 if echoes and min(echoes) > 0 else None


def volts_in(numbers: list[int]) -> float:
    """Returns a voltage, told in whole volts and ten-thousandths. Raises NoAnswerError."""
    if len(numbers) < 2:
        raise NoAnswerError("the robot told half a voltage")
    return numbers[0] + numbers[1] / 10_000.0


def share_in(numbers: list[int]) -> float:
    """Returns the charge of the battery, 0 to 1. Raises NoAnswerError."""
    if not numbers:
        raise NoAnswerError("the robot told no charge")
    try:
        return level_of(numbers[0], 100.0)
    except PancakesError as error:
        raise NoAnswerError(str(error)) from None
