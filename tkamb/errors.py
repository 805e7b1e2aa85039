"""The one error family: what went wrong, where, and how to mend it, in one line."""

import difflib
from collections.abc import Iterable

MOST_NAMES = 8
"""How many names a message lists."""


class TkambError(Exception):
    """Base of every error that tkamb raises on purpose.

    Args:
        what: what is wrong.
        where: file, key or frame number, if there is one.
        mend: what the user can do about it.
    """

    exit_status = 1

    def __init__(self, what: str, where: object = None, mend: str | None = None) -> None:
        self.what, self.where, self.mend = what, where, mend
        message = what if where is None else f"{where}: {what}"
        super().__init__(" ".join((message if mend is None else f"{message}; {mend}").split()))


class InputError(TkambError):
    """The user's input cannot be used: exit status 2, nothing written."""

    exit_status = 2


class ComputationError(TkambError):
    """Sound input, but nothing could be computed from it: exit status 1."""


def not_installed(package: str, where: object, extra: str) -> InputError:
    """Return the refusal of what needs a package that only an extra of tkamb brings."""
    return InputError(f"{package} is not installed", where, f"pip install 'tkamb[{extra}]'")


def names_near(name: str, names: Iterable[str], title: str = "there are") -> str:
    """Return "did you mean ..." with the names that resemble one, and the first of all names."""
    there = list(names)
    lower = {known.lower(): known for known in there}
    close = difflib.get_close_matches(name.lower(), lower, n=4, cutoff=0.6)
    more = ", …" if len(there) > MOST_NAMES else ""
    listed = f"{title}: {', '.join(there[:MOST_NAMES]) or 'none'}{more}"
    guess = f"did you mean {', '.join(lower[known] for known in close)}? " if close else ""
    return guess + listed
