"""Check the signature of a roster and keep it, in a process of its own, so that agents need no `cryptography`.

    python -m pancakes.security.check_roster FOLDER < roster

Exit codes: 0 if the folder now has the roster, `FALSE` if the authority has not signed it, `UNKEPT` if it is signed
but cannot be written, 1 if the signature cannot be checked. All but 0 come with a sentence on standard error.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pancakes.errors import PancakesError, needing_extra
from pancakes.security.key_store import FLEET, ROSTER, write_private
from pancakes.security.roster import FALSE, MOST_BYTES, UNKEPT, read_signed
from pancakes.util.files import read_plain


class FalseRosterError(PancakesError):
    """A roster that the authority of the fleet has not signed."""


class UnkeptRosterError(PancakesError):
    """A roster that the authority of the fleet has signed, but that cannot be written to the key folder."""


def check(folder: Path, text: bytes) -> None:
    """Check a roster, and keep it in a key folder.

    Raises:
        FalseRosterError: it is not a roster, or not signed by the authority of the folder's fleet.
        UnkeptRosterError: it was signed, but cannot be written.
        PancakesError: it cannot be checked.
    """
    with needing_extra("a roster cannot be checked"):
        from pancakes.security.authority import signed_by
    try:
        signed, roster = read_signed(text)
    except ValueError as error:
        raise FalseRosterError(str(error)) from None
    if not signed_by(folder / FLEET, signed):
        raise FalseRosterError(
            f"the roster {roster.number} was not signed by the authority of the fleet {roster.fleet}"
        )
    path = folder / ROSTER
    try:
        kept = read_signed(read_plain(path))[1].number if path.exists() else 0
        if kept < roster.number:
            write_private(path, text)
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else "") or str(error)
        raise UnkeptRosterError(f"the roster {roster.number} cannot be kept in {folder}: {why}") from None


def main() -> None:
    """The program."""
    try:
        check(Path(sys.argv[1]), sys.stdin.buffer.read(MOST_BYTES + 1))
    except PancakesError as error:
        print(error, file=sys.stderr)
        codes = {FalseRosterError: FALSE, UnkeptRosterError: UNKEPT}
        sys.exit(codes.get(type(error), 1))


if __name__ == "__main__":
    main()
