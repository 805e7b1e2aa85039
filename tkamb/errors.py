"""The errors of tkamb. A message is one line: where the error is, what is wrong, what to do."""

import difflib
from collections.abc import Iterable

# Largest number of names in a message. A message should be short.
MAX_NAMES = 8


class TkambError(Exception):
    """Base of every error that tkamb raises on purpose.

    Args:
        what: what is wrong.
        where: file, key, argument or frame; None: no place.
        hint: advice to the user; None: no advice.
    """

    exit_status = 1

    def __init__(
        self,
        what: str,
        where: object = None,
        hint: str | None = None,
    ) -> None:
        self.what, self.where, self.hint = what, where, hint
        message = what if where is None else f"{where}: {what}"
        super().__init__(" ".join((message if hint is None else f"{message}; {hint}").split()))


class InputError(TkambError):
    """The user's input cannot be used: exit status 2, and nothing is written."""

    exit_status = 2


class ComputationError(TkambError):
    """The input is valid, but nothing could be computed: exit status 1."""


def not_installed(package: str, where: object, extra: str) -> InputError:
    """Return the error for a missing package, with the pip command of tkamb's extra."""
    return InputError(f"{package} is not installed", where, f"pip install 'tkamb[{extra}]'")


def names_near(name: str, names: Iterable[str], title: str = "there are") -> str:
    """Return a hint: "did you mean ..." with similar names, then the first few of `names`."""
    all_names = list(names)
    lower = {each.lower(): each for each in all_names}
    close = difflib.get_close_matches(name.lower(), lower, n=4, cutoff=0.6)
    more = ", …" if len(all_names) > MAX_NAMES else ""
    listed = f"{title}: {', '.join(all_names[:MAX_NAMES]) or 'none'}{more}"
    guess = f"did you mean {', '.join(lower[each] for each in close)}? " if close else ""
    return guess + listed
