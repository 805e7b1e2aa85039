"""Runs a command so that every error reaches the user as one line.

A command ends with a status: 0 done, 1 nothing computed, 2 bad input, 130 interrupted. An
unforeseen error is one line too; its traceback goes into a file beside the output.
"""

import argparse
import errno
import io
import json
import logging
import os
import re
import sys
import tempfile
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
"""Error numbers of a write when the disk, the quota or the limit of a file is reached."""

OPTIONS = {
    "camera": "--camera",
    "frame": "--frame",
    "frames": "--frames",
    "method": "--method",
    "overrides": "--set",
    "restore_when": "--restore-when",
    "samples": "--samples",
    "workers": "--workers",
}
"""Argument of a Python function -> option of a command."""


def guarded(command: Callable[[], int], options: argparse.Namespace) -> int:
    """Run a command and return its exit status; an error reaches the user as one line.

    Args:
        command: returns its own status.
        options: of the command line, as far as they are known when something goes wrong.
    """
    open_streams()
    try:
        with warnings.catch_warnings():
            if not sys.warnoptions:
                warnings.simplefilter("ignore")  # they are for whoever writes the code
            try:
                with interrupt_as_such():
                    return command()
            finally:  # also when argparse exits: what it printed must have arrived
                sys.stdout.flush()
    except TkambError as error:
        say(in_options(str(error), error.where))
        if isinstance(error, StreamError):
            _silence(sys.stdout)
        return error.exit_status
    except BrokenPipeError:  # the reader of a pipe has gone, `tkamb ... | head`
        _silence(sys.stdout)
        return 0
    except KeyboardInterrupt as interrupt:
        say(f"interrupted: {in_options(str(interrupt)) or 'nothing is kept'}")
        return 130
    except OSError as error:
        if error.errno not in NO_ROOM:
            return _unforeseen(error, options)
        where = "" if error.filename is None else f"{error.filename}: "
        say(f"{where}cannot be written ({error.strerror}); make room, then run it again")
        return 1
    except Exception as error:
        return _unforeseen(error, options)


def in_options(message: str, where: object = None) -> str:
    """Return a message that names arguments of Python functions with options of commands instead.

    Args:
        message: what is printed.
        where: of the error; it may begin with the name of an argument.
    """
    name = where.partition(" ")[0] if isinstance(where, str) else ""
    if name in OPTIONS:
        message = OPTIONS[name] + message.removeprefix(name)
    message = re.sub(r"\b(adjust|force|resume)=True\b", r"--\1", message)
    message = message.replace("frames=slice(A, B, STEP)", "--frames A:B:STEP")
    return message.replace("another directory", "another folder with --out")


@contextmanager
def interrupt_as_such() -> Iterator[None]:
    """Raise KeyboardInterrupt where an interrupt within a compiled loop became a SystemError.

    Python raises the SystemError, caused by the interrupt, where the loop returns its result.
    """
    try:
        yield
    except SystemError as error:
        cause: BaseException | None = error
        while isinstance(cause, SystemError):  # one for each layer that it passes
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise


class StreamError(TkambError):
    """Standard output cannot be written: what was computed has not arrived."""


def say(line: str) -> None:
    """Print a line on standard error, if that is still open."""
    with suppress(OSError, ValueError):
        print(f"tkamb: {printable(line)}", file=sys.stderr, flush=True)


def printable(text: str) -> str:
    """Return a text with characters that could steer a terminal as in JSON; lines and tabs stay."""
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    return "".join(c if _is_harmless(c) else json.dumps(c)[1:-1] for c in text)


def _is_harmless(character: str) -> bool:
    return character.isprintable() or character in "\n\t" or category(character) == "Zs"


class _PrintableFormatter(logging.Formatter):
    """Escapes what could steer a terminal: messages quote names and texts of others."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def log_to_stderr() -> None:
    """Have warnings printed on standard error, as tkamb's."""
    handler = logging.StreamHandler()
    handler.setFormatter(_PrintableFormatter("tkamb: %(levelname)s: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)


def open_streams() -> None:
    """Open those of the three standard streams that the process was started without.

    A stream that is closed would leave its number to the next file that is opened, and what is
    printed would end in it. Standard output is opened for reading then: printing fails, as it
    should, when there is something to print.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # the lowest free number is given: this one
            os.open(os.devnull, os.O_RDONLY if number == 1 else os.O_RDWR)
    if sys.stdout is None:
        sys.stdout = sys.__stdout__ = open(1, "w", encoding="utf-8", closefd=False)  # type: ignore[misc]  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    try:
        os.write(2, b"")  # nothing, but /dev/full says so
    except OSError:
        _silence(sys.stderr)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names of files may hold what the encoding does not have.
        sys.stdout.reconfigure(errors="backslashreplace")
        if sys.stdout is sys.__stdout__ and "write" not in vars(sys.stdout):
            _watch(sys.stdout)
    logging.raiseExceptions = False


def _watch(stream: TextIO) -> None:
    """Make a stream raise `StreamError` when it cannot be written, as on a full disk.

    What is written is `printable`: commands print names and texts from files of others.
    """
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
    """Redirect a standard stream to the null device, so that the last flush does not fail."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # type: ignore[attr-defined]


def _unforeseen(error: Exception, options: argparse.Namespace) -> int:
    say(unforeseen_words(error, options))
    return 1


def unforeseen_words(error: Exception, options: argparse.Namespace) -> str:
    """Return one line on an error that tkamb does not raise itself; its traceback goes into a file.

    An error of a plug-in names the plug-in.

    Args:
        error: what was raised.
        options: of the command line; its `out` says where the file goes.
    """
    name = type(error).__name__
    reason = " ".join(str(error).split())[:200]
    what = "not enough memory: take a coarser resolution or fewer frames"
    if not isinstance(error, MemoryError):
        from tkamb.run.identity import raised_in

        plug_in, told = raised_in(error), f"{name}{': ' if reason else ''}{reason}"
        what = f"{plug_in} raised {told}" if plug_in else f"this was not foreseen: {told}"
    log = _write_log(error, options)
    return f"{what}; {'no log could be written' if log is None else f'details are in {log}'}"


def _write_log(error: Exception, options: argparse.Namespace) -> Path | None:
    """Write the traceback beside the output, else here, else where temporary files go."""
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
    beside = [] if out is None else [out, out.parent]
    return [*(path for path in beside if path.is_dir()), Path.cwd(), Path(tempfile.gettempdir())]
