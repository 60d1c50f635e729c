"""Runs code as a user for whom file modes count.

CI is root, and root may read and write every file. So a test that expects a refusal runs its code in a child process
that has become the user `nobody`. Where the tests do not run as root, the code runs as it is.
"""

from __future__ import annotations

import os
import pickle
import pwd
import shutil
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest

T = TypeVar("T")

IS_ROOT = os.geteuid() == 0
NOBODY = pwd.getpwnam("nobody")
needs_root = pytest.mark.skipif(not IS_ROOT, reason="only root can give a file to another user")


@contextmanager
def reachable_folder() -> Iterator[Path]:
    """Makes a folder that the other user can reach, and cannot write: those of pytest are in one of root's."""
    path = Path(tempfile.mkdtemp(prefix="pancakes-other-user-"))
    path.chmod(0o755)
    yield path
    for folder in (path, *path.rglob("*")):
        if folder.is_dir():
            folder.chmod(0o700)
    shutil.rmtree(path)


def theirs(path: Path, mode: int) -> Path:
    """Gives a file or folder to the other user, with a mode."""
    path.chmod(mode)
    if IS_ROOT:
        os.chown(path, NOBODY.pw_uid, NOBODY.pw_gid)
    return path


def unreadable(path: Path) -> Path:
    """Takes a file or folder from the other user."""
    path.chmod((0o700 if path.is_dir() else 0o600) if IS_ROOT else 0)
    return path


def unwritable(path: Path) -> Path:
    """Makes a folder one in which the other user can make no file."""
    path.mkdir(exist_ok=True)
    path.chmod(0o755 if IS_ROOT else 0o555)
    return path


def as_other_user(function: Callable[[], T]) -> T:
    """Calls a function as the other user; returns what it returns, or raises what it raises.

    The child is forked, because the other user may not be able to read Python itself (a pyenv of root's). So whatever
    the function imports must be imported before: have a test call it once as it is, or import what it needs.

    Args:
        function: what is called; its result is pickled.
    """
    if not IS_ROOT:
        return function()
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DeprecationWarning
        )  # that other threads run here, which the child does not need
        child = os.fork()
    if not child:
        os.close(reading)
        _run_in_child(function, writing)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        told = file.read()
    os.waitpid(child, 0)
    assert told, "the child of the other user ended without a result"
    good, result = pickle.loads(told)
    if not good:
        error, text = result
        error.add_note(text)
        raise error
    answer: T = result
    return answer


def _run_in_child(function: Callable[[], Any], writing: int) -> None:
    """Becomes the other user, and ends this process with the result in the pipe."""
    try:
        os.setgroups([])
        os.setgid(NOBODY.pw_gid)
        os.setuid(NOBODY.pw_uid)
        os.environ["HOME"] = NOBODY.pw_dir
        try:
            told = pickle.dumps((True, function()))
        except BaseException as error:
            text = traceback.format_exc()
            try:
                told = pickle.dumps((False, (error, text)))
            except Exception:
                told = pickle.dumps((False, (AssertionError(f"{type(error).__name__}: {error}"), text)))
        with os.fdopen(writing, "wb") as file:
            file.write(told)
    finally:
        sys.stdout.flush()
        os._exit(0)
