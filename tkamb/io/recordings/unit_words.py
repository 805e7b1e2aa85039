"""Unit words as recordings write them: `N`, `nt`, `Newtons`, `N-mm`, `NMM`, `mete`, `Millimeters`.

Case, blanks, dots, hyphens and asterisks do not matter. A word is a unit only if it is in the
lists below; any other is refused where the quantity is needed, never guessed.
"""

from dataclasses import dataclass

from tkamb.units import MILLIMETRE

LENGTH_WORDS = {
    **dict.fromkeys(("m", "mete", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("cm", "cent", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(
        ("mm", "mill", "millimeter", "millimeters", "millimetre", "millimetres"), MILLIMETRE
    ),
}
"""Metres per unit. Four letters alone are what some programs leave of a longer word."""
FORCE_WORDS = {
    **dict.fromkeys(("n", "nt", "newt", "newton", "newtons"), 1.0),
    **dict.fromkeys(("kn", "kilonewton", "kilonewtons"), 1e3),
}
"""Newtons per unit."""

_SEPARATORS = str.maketrans("", "", " .*-·⋅_\x00\t")


@dataclass(frozen=True)
class GivenUnits:
    """Units that the user states for words of a recording that are missing or not understood.

    Args:
        length: of markers and plates: m, cm or mm; None: the recording says.
        force: of force channels, like N; None: the recording says.
        moment: of moment channels, like Nmm; None: the recording says.
    """

    length: str | None = None
    force: str | None = None
    moment: str | None = None


def plain_unit(word: str) -> str:
    """Return a unit word without case, blanks and separators."""
    return word.translate(_SEPARATORS).lower()


def metres(word: str) -> float | None:
    """Return metres per unit of length; None for a word that is not a unit."""
    return LENGTH_WORDS.get(plain_unit(word))


def newtons(word: str) -> float | None:
    """Return newtons per unit of force; None for a word that is not a unit."""
    return FORCE_WORDS.get(plain_unit(word))


def newton_metres(word: str) -> float | None:
    """Return newton metres per unit of moment, a force word and a length word; else None."""
    plain = plain_unit(word)
    for cut in range(1, len(plain)):
        force, length = FORCE_WORDS.get(plain[:cut]), LENGTH_WORDS.get(plain[cut:])
        if force is not None and length is not None:
            return force * length
    return None
