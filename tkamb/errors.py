"""The errors of tkamb. A message is one line: where the error is, what is wrong, what to do."""

import difflib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np

Kind = TypeVar("Kind")

# Largest number of names in a message. A message should be short.
MAX_NAMES = 8
# Largest number of characters of a value in a message.
MAX_SHOWN = 60


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


def must_be(value: object, kinds: type | tuple[type, ...], where: object, hint: str) -> None:
    """Raise an InputError if an argument is of none of the kinds."""
    if not isinstance(value, kinds):
        raise _wrong_kind(value, where, hint)


def all_of(kind: type[Kind], values: Iterable[Kind], where: str, hint: str) -> tuple[Kind, ...]:
    """Return the values of an argument; if one of them is of another kind, raise an InputError."""
    must_be(values, Iterable, where, hint)
    kept = tuple(values)
    for value in kept:
        must_be(value, kind, where, hint)
    return kept


def real_numbers(values: Any, where: object, hint: str) -> "np.ndarray":
    """Return an argument as an array of float; text, bool and complex numbers are refused.

    Raises:
        InputError: see above, or the rows have different lengths.
    """
    import numpy as np  # `main` sets the threads of BLAS before NumPy is loaded

    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(f"holds no numbers: {error}", where, hint) from None
    if array.dtype.kind not in "fiu" and array.size:
        raise _wrong_kind(array if array.shape else values, where, hint)
    return array.astype(float, copy=False)


def real_number(value: Any, where: object, hint: str) -> float:
    """Return an argument as a float; all but one real number is refused.

    Raises:
        InputError: see above.
    """
    array = real_numbers(value, where, hint)
    if array.shape:
        raise _wrong_kind(array, where, hint)
    return float(array)


def _wrong_kind(value: Any, where: object, hint: str) -> InputError:
    shown = repr(value)
    if hasattr(value, "dtype") and value.shape:
        shown = f"an array of {value.dtype}, shape {value.shape}"
    elif len(shown) > MAX_SHOWN:
        shown = f"of type {type(value).__name__}"
    return InputError(f"cannot be {shown}", where, hint)


def not_installed(package: str, where: object, extra: str) -> InputError:
    """Return the error for a missing package, with the pip command of tkamb's extra."""
    return InputError(f"{package} is not installed", where, f"pip install 'tkamb[{extra}]'")


def names_among(values: Any, names: Iterable[str], where: str, what: str) -> tuple[str, ...]:
    """Return an argument that lists some of `names`; `what` is their kind in the message.

    Raises:
        InputError: the argument is a text or no list, or a name is unknown.
    """
    all_names = list(names)
    hint = f"give a list of {', '.join(all_names)}"
    if isinstance(values, str):
        raise InputError(f"is the text '{values}'", where, f'give a list: ["{values}"]')
    for name in (listed := all_of(str, values, where, hint)):
        if name not in all_names:
            raise InputError(f"no {what} '{name}'", where, names_near(name, all_names))
    return listed


def names_near(name: str, names: Iterable[str], title: str = "there are") -> str:
    """Return a hint: "did you mean ..." with similar names, then the first few of `names`."""
    all_names = list(names)
    lower = {each.lower(): each for each in all_names}
    close = difflib.get_close_matches(name.lower(), lower, n=4, cutoff=0.6)
    more = ", …" if len(all_names) > MAX_NAMES else ""
    listed = f"{title}: {', '.join(all_names[:MAX_NAMES]) or 'none'}{more}"
    guess = f"did you mean {', '.join(lower[each] for each in close)}? " if close else ""
    return guess + listed
