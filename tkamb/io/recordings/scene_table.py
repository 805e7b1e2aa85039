"""Building blocks of the scene's tables: base class, units, numbers and limits."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Strict

LengthUnit = Literal["m", "cm", "mm", "inch"]
AngleUnit = Literal["rad", "deg"]
Number = Annotated[float, Strict()]
"""A number. `true` and a number in quotes are refused."""
Count = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]
PatellaFreedom = Literal["ap", "si", "shift", "flexion", "tilt", "rotation"]
KneeFreedom = Literal["ap", "si", "ml", "axial_rotation", "adduction"]
Closing = Literal["interpolate", "there-and-back", "as recorded"]
"""How recorded frames become a cycle of wear, see `tkamb.studies.wear.motion`."""
DEFAULT_CLOSING: Closing = "interpolate"


def _axes(text: str) -> str:
    names = [part.strip() for part in text.split(",")]
    if len(names) != 3 or sorted(n.lstrip("+-") for n in names) != ["x", "y", "z"]:
        raise ValueError(
            "must name three different axes for anterior, superior and right, e.g. '-x,+y,-z'"
        )
    return ",".join(n if n[0] in "+-" else f"+{n}" for n in names)


Axes = Annotated[str, AfterValidator(_axes)]


def within(low: float, high: float, hint: str) -> Any:
    """Return the annotation of a number, or of a vector, with values from `low` to `high`."""

    def checked(value: Any) -> Any:
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not low <= number <= high:
                raise ValueError(f"{number:g} is not within {low:g} to {high:g}; {hint}")
        return value

    return AfterValidator(checked)


def zero_or_within(low: float, high: float, hint: str) -> Any:
    """Return the annotation of a number that is zero, or from `low` to `high`."""

    def checked(value: float) -> float:
        if value != 0 and not low <= value <= high:
            raise ValueError(f"{value:g} is neither 0 nor within {low:g} to {high:g}; {hint}")
        return value

    return AfterValidator(checked)


HalfThickness = Annotated[Number, zero_or_within(0.2, 20, "give it in millimetres")]
"""mm: distance of a tendon's centre line from the outline that it wraps; zero: no thickness."""
Band = Annotated[Number, zero_or_within(0.1, 50, "give it in millimetres")]
"""mm: distance up to which a tendon wraps sections beside its sagittal plane; zero: this plane
only."""
Point = Annotated[Vector, within(-1000, 1000, "give it in millimetres")]
"""mm: point on a bone. The limit allows for a bone of 0.6 m and an origin beside it."""
Offset = Annotated[Vector, within(-600, 600, "give it in millimetres")]
"""mm: position of a mesh's origin in a link. The limit is the length of a bone."""
Turn = Annotated[Vector, within(-360, 360, "give it in degrees")]


def _known_format(name: str) -> str:
    from tkamb.io.recordings.tables import READERS

    if name not in READERS:
        raise ValueError(f"unknown table format '{name}', use {', '.join(READERS)}")
    return name


TableFormat = Annotated[str, AfterValidator(_known_format)]
FORMAT = "csv, sto, mot, trc or c3d; default: the suffix"


class SceneTable(BaseModel):
    """A table of the scene file: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
