"""Open the standard files that the program was started without (`<&-`, `>&-`)."""

from __future__ import annotations

import os


def fill_standard_files() -> None:
    """Open the null device in the place of each closed one.

    Otherwise the next file that the program opens, such as a log, would be standard input or output.
    """
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(handle, True)
    os.close(handle)
