"""Checks a roster that came in, and keeps it: a process of its own, so that no running agent needs `cryptography`.

    python -m pancakes.mesh.security.check_roster FOLDER < roster

It ends with 0 if the folder with keys has the roster now, with `FALSE` if the authority has not signed it, with
`UNKEPT` if the authority has signed it and the folder cannot take it, and with 1 if the signature cannot be checked.
Each but the first comes with a sentence on standard error.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pancakes.errors import PancakesError, needing_extra
from pancakes.mesh.security.key_files import FLEET, ROSTER, write_private
from pancakes.mesh.security.roster import FALSE, MOST_BYTES, UNKEPT, read_signed
from pancakes.runtime.foundation.plain_file import read_plain


class FalseRoster(PancakesError):
    """A roster that the authority of the fleet has not signed."""


class UnkeptRoster(PancakesError):
    """A roster that the authority of the fleet has signed, and that cannot be written beside the keys."""


def check(folder: Path, text: bytes) -> None:
    """Keeps a roster in a folder with keys.

    Raises:
        FalseRoster: it is none, or was not signed by the authority of the folder's fleet.
        UnkeptRoster: it was signed, and cannot be written.
        PancakesError: it cannot be checked.
    """
    with needing_extra("a roster cannot be checked"):
        from pancakes.mesh.security.authority import signed_by
    try:
        signed, roster = read_signed(text)
    except ValueError as error:
        raise FalseRoster(str(error)) from None
    if not signed_by(folder / FLEET, signed):
        raise FalseRoster(f"the roster {roster.number} was not signed by the authority of the fleet {roster.fleet}")
    path = folder / ROSTER
    try:
        kept = read_signed(read_plain(path))[1].number if path.exists() else 0
        if kept < roster.number:
            write_private(path, text)
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else "") or str(error)
        raise UnkeptRoster(f"the roster {roster.number} cannot be kept in {folder}: {why}") from None


def main() -> None:
    """The program."""
    try:
        check(Path(sys.argv[1]), sys.stdin.buffer.read(MOST_BYTES + 1))
    except PancakesError as error:
        print(error, file=sys.stderr)
        codes = {FalseRoster: FALSE, UnkeptRoster: UNKEPT}
        sys.exit(codes.get(type(error), 1))


if __name__ == "__main__":
    main()
