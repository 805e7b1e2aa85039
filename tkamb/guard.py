"""What stands between a command and its user: one line for whatever goes wrong.

A command ends with a status: 0 done, 1 nothing computed, 2 bad input, 130 interrupted. What
nobody foresaw is one line too; its traceback goes into a file beside the output.
"""

import argparse
import io
import logging
import os
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from tkamb.errors import TkambError


def guarded(command: Callable[[], int], options: argparse.Namespace) -> int:
    """Run a command and return its exit status; nothing but a line ever reaches the user.

    Args:
        command: returns its own status.
        options: of the command line, as far as they are known when something goes wrong.
    """
    open_streams()
    try:
        with warnings.catch_warnings():
            if not sys.warnoptions:
                warnings.simplefilter("ignore")  # they are for whoever writes the code
            status = command()
        sys.stdout.flush()
        return status
    except SystemExit:  # argparse has said what was wrong, or printed what was asked for
        return _flushed_exit()
    except TkambError as error:
        say(str(error))
        return error.exit_status
    except BrokenPipeError:  # the reader of a pipe has gone, `tkamb ... | head`
        _silence(sys.stdout)
        return 0
    except KeyboardInterrupt as interrupt:
        say(f"interrupted: {interrupt or 'nothing is kept'}")
        return 130
    except Exception as error:
        if isinstance(error, OSError) and _stdout_fails():
            return 1
        return _unforeseen(error, options)


def say(line: str) -> None:
    """Print a line on standard error; where that is gone there is nobody to tell."""
    plain = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    with suppress(OSError, ValueError):
        print(f"tkamb: {plain}", file=sys.stderr, flush=True)


def open_streams() -> None:
    """Have the three standard streams there, whatever the process was started with.

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
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    try:
        os.write(2, b"")  # nothing, but /dev/full says so
    except OSError:
        _silence(sys.stderr)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names of files may hold what the encoding does not have.
        sys.stdout.reconfigure(errors="backslashreplace")
    logging.raiseExceptions = False


def _flushed_exit() -> int:
    error = sys.exception()
    assert isinstance(error, SystemExit)
    with suppress(OSError):
        sys.stdout.flush()
        raise error
    _stdout_fails()
    return 1


def _stdout_fails() -> bool:
    """Say on standard error that standard output cannot be written, if that is so."""
    try:
        sys.stdout.flush()
    except OSError as error:
        say(f"standard output cannot be written ({error.strerror})")
        _silence(sys.stdout)
        return True
    return False


def _silence(stream: object) -> None:
    """Lead a standard stream to nowhere, so that the interpreter's last flush does not fail."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # type: ignore[attr-defined]


def _unforeseen(error: Exception, options: argparse.Namespace) -> int:
    name = type(error).__name__
    reason = " ".join(str(error).split())[:200]
    what = "not enough memory: take a coarser resolution or fewer frames"
    if not isinstance(error, MemoryError):
        what = f"this was not foreseen: {name}{': ' if reason else ''}{reason}"
    log = _write_log(error, options)
    say(f"{what}; {'no log could be written' if log is None else f'details are in {log}'}")
    return 1


def _write_log(error: Exception, options: argparse.Namespace) -> Path | None:
    """Write the traceback beside the output, else here, else where temporary files go."""
    text = "".join(
        (
            f"tkamb {version('tkamb')}, {datetime.now(UTC).isoformat(timespec='seconds')}\n",
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
