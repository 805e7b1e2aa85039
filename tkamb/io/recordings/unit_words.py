"""Unit words in recordings, like `N`, `nt`, `Newtons`, `N-mm`, `NMM`, `mete`, `Millimeters`.

Case, blanks, dots, hyphens and asterisks are ignored. Only the listed words are units. For another
word, a reader raises an error when it needs the quantity. No unit is guessed.
"""

from dataclasses import dataclass

from tkamb.units import LENGTH, MILLIMETRE, STANDARD_GRAVITY

POUND_FORCE = 0.45359237 * STANDARD_GRAVITY
"""N; the international avoirdupois pound (1959) under standard gravity."""

LENGTH_WORDS = {
    **dict.fromkeys(("m", "mete", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("cm", "cent", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(
        ("mm", "mill", "millimeter", "millimeters", "millimetre", "millimetres"), MILLIMETRE
    ),
    **dict.fromkeys(("in", "inch", "inches"), LENGTH["inch"]),
    **dict.fromkeys(("ft", "foot", "feet"), 12 * LENGTH["inch"]),
}
"""Metres per unit. Some programs shorten a word to four letters."""
FORCE_WORDS = {
    **dict.fromkeys(("n", "nt", "newt", "newton", "newtons"), 1.0),
    **dict.fromkeys(("dan", "decanewton", "decanewtons"), 10.0),
    **dict.fromkeys(("kn", "kilonewton", "kilonewtons"), 1e3),
    **dict.fromkeys(("kgf", "kp", "kilopond", "kiloponds"), STANDARD_GRAVITY),
    **dict.fromkeys(("lb", "lbs", "lbf", "pound", "pounds"), POUND_FORCE),
}
"""Newtons per unit."""
LENGTH_FIRST = ("in", "inch", "ft", "foot")
"""Units of length that may precede the force, as in `in-lb`. `mN` is a millinewton."""

_SEPARATORS = str.maketrans("", "", " .*-·⋅_\x00\t")


@dataclass(frozen=True)
class GivenUnits:
    """Units that the user states. None: the unit that the recording states.

    Args:
        length: unit of markers and plates, like mm.
        force: unit of force channels, like N.
        moment: unit of moment channels, like Nmm.
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
    """Return newton metres per unit of moment; None for a word that is not a unit.

    A unit of moment is a unit of force, then one of length. Inches and feet may also come first.
    """
    plain = plain_unit(word)
    for first in LENGTH_FIRST:
        if plain.startswith(first) and plain[len(first) :] in FORCE_WORDS:
            return LENGTH_WORDS[first] * FORCE_WORDS[plain[len(first) :]]
    for cut in range(1, len(plain)):
        force_unit, length_unit = FORCE_WORDS.get(plain[:cut]), LENGTH_WORDS.get(plain[cut:])
        if force_unit is not None and length_unit is not None:
            return force_unit * length_unit
    return None
