"""Execution of a command, with each error as one line on standard error.

Exit statuses: 0 success, 1 failure, 2 bad input, 130 interrupted. An unexpected error's traceback
is written to a log file.
"""

import argparse
import errno
import io
import json
import logging
import os
import re
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO
from unicodedata import category

from tkamb import __version__
from tkamb.errors import TkambError

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Error numbers of a write to a full disk, beyond the quota or beyond the largest file size."""

OPTIONS = {
    "camera": "--camera",
    "frame": "--frame",
    "frames": "--frames",
    "load": "--load",
    "method": "--method",
    "overrides": "--set",
    "restore_when": "--restore-when",
    "samples": "--samples",
    "workers": "--workers",
}
"""Argument of a Python function -> option of a command."""


def guarded(command: Callable[[], int], options: argparse.Namespace) -> int:
    """Run a command and return its exit status; an error is printed as one line."""
    open_streams()
    try:
        with warnings.catch_warnings():
            if not sys.warnoptions:
                warnings.simplefilter("ignore")  # Python warnings address developers
            try:
                with interrupt_as_such(), terminated_as_interrupted():
                    return command()
            finally:  # also after an exit by argparse, so that a failed write is reported
                sys.stdout.flush()
    except TkambError as error:
        say(in_options(str(error), error.where))
        if isinstance(error, StreamError):
            _silence(sys.stdout)
        return error.exit_status
    except BrokenPipeError:  # the reader of the pipe has ended, as in `tkamb ... | head`
        _silence(sys.stdout)
        return 0
    except KeyboardInterrupt as interrupt:
        say(f"interrupted: {in_options(str(interrupt)) or 'nothing is kept'}")
        return 130
    except OSError as error:
        if error.errno not in NO_ROOM:
            return _unexpected(error, options)
        where = "" if error.filename is None else f"{error.filename}: "
        say(f"{where}cannot be written ({error.strerror}); make room, then run it again")
        return 1
    except Exception as error:
        return _unexpected(error, options)


def in_options(message: str, where: object = None) -> str:
    """Return a message with options in place of arguments of Python functions.

    Args:
        where: place of the error; its first word may be the name of an argument.
    """
    name = where.partition(" ")[0] if isinstance(where, str) else ""
    if name in OPTIONS:
        message = OPTIONS[name] + message.removeprefix(name)
    message = re.sub(r"\b(adjust|force|resume)=True\b", r"--\1", message)
    message = message.replace("frames=slice(A, B, STEP)", "--frames A:B:STEP")
    return message.replace("another directory", "another folder with --out")


@contextmanager
def interrupt_as_such() -> Iterator[None]:
    """Raise KeyboardInterrupt for a SystemError by an interrupt in compiled code."""
    try:
        yield
    except SystemError as error:
        cause: BaseException | None = error
        while isinstance(cause, SystemError):  # each compiled layer adds one SystemError
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Raise KeyboardInterrupt for SIGTERM, so that finished frames are published and temporary
    folders removed.
    """
    if threading.current_thread() is not threading.main_thread():  # only it receives signals
        yield
        return
    handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)


class StreamError(TkambError):
    """Standard output cannot be written."""


def say(line: str) -> None:
    """Print a line on standard error if the stream is open."""
    with suppress(OSError, ValueError):
        print(f"tkamb: {printable(line)}", file=sys.stderr, flush=True)


def printable(text: str) -> str:
    """Return a text with control characters escaped as in JSON, except line breaks and tabs."""
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    return "".join(c if _is_harmless(c) else json.dumps(c)[1:-1] for c in text)


def _is_harmless(character: str) -> bool:
    return character.isprintable() or character in "\n\t" or category(character) == "Zs"


class _PrintableFormatter(logging.Formatter):
    """Escapes control characters: messages quote texts from files, which could alter a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def log_to_stderr() -> None:
    """Print logged warnings on standard error with the prefix "tkamb"."""
    handler = logging.StreamHandler()
    handler.setFormatter(_PrintableFormatter("tkamb: %(levelname)s: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)


def open_streams() -> None:
    """Open closed standard streams, and make failed writes raise `StreamError`.

    The next opened file would get a closed stream's number, and printed text. A closed standard
    output is opened for reading only, so that printing fails.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # the system assigns the lowest free number, which is this one
            os.open(os.devnull, os.O_RDONLY if number == 1 else os.O_RDWR)
    if sys.stdout is None:
        sys.stdout = sys.__stdout__ = open(1, "w", encoding="utf-8", closefd=False)  # type: ignore[misc]  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    try:
        os.write(2, b"")  # fails if the stream is /dev/full
    except OSError:
        _silence(sys.stderr)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # File names may contain characters that the encoding lacks.
        sys.stdout.reconfigure(errors="backslashreplace")
        if sys.stdout is sys.__stdout__ and "write" not in vars(sys.stdout):
            _watch(sys.stdout)
    logging.raiseExceptions = False


def _watch(stream: TextIO) -> None:
    for name in ("write", "flush"):
        inner = getattr(stream, name)

        def call(*arguments: str, inner: Callable[..., object] = inner) -> object:
            try:
                return inner(*map(printable, arguments))
            except BrokenPipeError:
                raise
            except OSError as error:
                what = f"standard output cannot be written ({error.strerror})"
                raise StreamError(what) from None

        setattr(stream, name, call)


def _silence(stream: object) -> None:
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # type: ignore[attr-defined]


def _unexpected(error: Exception, options: argparse.Namespace) -> int:
    say(unforeseen_words(error, options))
    return 1


def unforeseen_words(error: Exception, options: argparse.Namespace) -> str:
    """Return one line on an unexpected error, and write its traceback to a log file.

    It names the plug-in that raised the error, if any.

    Args:
        options: options of the command line; the log file goes to the folder `out`.
    """
    name = type(error).__name__
    reason = " ".join(str(error).split())[:200]
    what = "not enough memory: choose a coarser resolution or fewer frames"
    if not isinstance(error, MemoryError):
        from tkamb.run.identity import raised_in

        plug_in, raised = raised_in(error), f"{name}{': ' if reason else ''}{reason}"
        what = f"{plug_in} raised {raised}" if plug_in else f"unexpected error: {raised}"
    log = _write_log(error, options)
    return f"{what}; {'no log could be written' if log is None else f'details are in {log}'}"


def _write_log(error: Exception, options: argparse.Namespace) -> Path | None:
    text = "".join(
        (
            f"tkamb {__version__}, {datetime.now(UTC).isoformat(timespec='seconds')}\n",
            f"{sys.argv}\n",
            *traceback.format_exception(error),
        )
    )
    for folder in _log_folders(getattr(options, "out", None)):
        with suppress(OSError, ValueError):
            handle, name = tempfile.mkstemp(".log", "tkamb-error-", folder)
            with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(text)
            return Path(name)
    return None


def _log_folders(out: Path | None) -> list[Path]:
    """Return the output folder and its parent, the working and the temporary directory."""
    beside = [] if out is None else [out, out.parent]
    return [*(path for path in beside if path.is_dir()), Path.cwd(), Path(tempfile.gettempdir())]
