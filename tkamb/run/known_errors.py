"""By how much each contact model is known to err, and what it leaves out of a bearing.

The errors are relative, against converged references: the largest over the cases on which a
setting was measured. They hold for these cases, and are no bound for others. The cases are
those of the trade-off study and half of the pairs of bodies of `error_cases`. The other half is
held out: it is used to check which share of new errors stays within the stated ones
(docs/known_errors.md). `run/known_errors.json` is written by `scripts/make_tradeoff_table`. A
setting that was not measured is reported as "not measured"; no error is interpolated.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

STORED = Path(__file__).with_name("known_errors.json")


@dataclass(frozen=True)
class KnownErrorSettings:
    """How known errors of the contact settings are shown."""

    notable_share: float = 0.10
    """1: share of the reference; a known error above it is shown in colour. Chosen: a reader should
    not miss it."""


KNOWN_ERROR = KnownErrorSettings()

NOT_MEASURED = "not measured"
SAME_ANSWER = ("cache",)
"""Options that change the time of an answer, not the answer."""


@dataclass(frozen=True)
class KnownError:
    """Largest relative errors of one setting.

    Args:
        approach: of the travel since first touch.
        force: of a condyle's force, relative to the load; None where no case had two condyles.
        mean_pressure: of a condyle.
        peak_pressure: of a condyle.
        area: of a condyle.
        cases: number of cases on which it was measured.
        situations: where contact lies ("interior", "flank", "edge") -> quantity -> largest error
            there, of contact that carried no flag but that of the edge.
        covered: share of the errors on held-out pairs that are within the stated ones; None
            where none was held out.
    """

    approach: float
    force: float | None
    mean_pressure: float
    peak_pressure: float
    area: float
    cases: int
    situations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    covered: float | None = None


def setting_label(model: str, options: Mapping[str, Any]) -> str:
    """Return the label of a setting in the trade-off study: the model's name and given options."""
    own = ",".join(f"{key}={value}" for key, value in options.items() if key not in SAME_ANSWER)
    return f"{model}[{own}]" if own else model


@cache
def known_errors() -> dict[tuple[str, float, str], KnownError]:
    """Return (label, resolution in mm, material) -> known error."""
    rows = json.loads(STORED.read_text(encoding="utf-8"))
    return {
        (row.pop("contact"), float(row.pop("resolution_mm")), row.pop("material")): KnownError(
            **row
        )
        for row in rows
    }


def known_error(
    model: str, resolution_mm: float, material: str, options: Mapping[str, Any] | None = None
) -> KnownError | None:
    """Return by how much a setting is known to err; None where it was not measured.

    Args:
        model: name of the contact model. Models of other packages were not measured.
        resolution_mm: spacing of its map points. Only the spacings of the study were measured.
        material: of the insert; polyethylene and polyethylene-linear were measured.
        options: the model's own.
    """
    label = setting_label(model, options or {})
    return known_errors().get((label, float(resolution_mm), material))


def left_out(model: str, bearing: str) -> tuple[str, ...]:
    """Return in words what a contact model leaves out of a bearing, "fixed" or "mobile"."""
    from tkamb.contact.registry import contact_class  # only where contact is modelled

    if bearing == "fixed" or contact_class(model).mobile_bearing:
        return ()
    return (f"The bearing is mobile, but {model} presses it like a fixed one.",)


def as_json(error: KnownError | None) -> dict[str, Any] | str:
    """Return what summary.json and `tkamb press --json` say under `known_error`."""
    return NOT_MEASURED if error is None else asdict(error)


def known_error_words(error: Mapping[str, Any] | str, names: Iterable[str]) -> str:
    """Return the errors of some quantities in words.

    Args:
        error: what summary.json holds under `known_error`.
        names: quantities, fields of `KnownError`.
    """
    if isinstance(error, str):
        return f"error of this setting: {error}"
    parts = ", ".join(f"{100 * error[name]:.2g} % in {name.replace('_', ' ')}" for name in names)
    words = f"in {error['cases']} reference cases the contact model was off by {parts}"
    situations = error.get("situations") or {}
    stated = [name for name in names if name in ("peak_pressure", "area")]
    places = [
        f"{_PLACES[place]} {' and '.join(f'{100 * errors[name]:.2g} %' for name in stated)}"
        for place, errors in situations.items()
    ]
    if stated and places:
        quantities = " and ".join(name.replace("_", " ") for name in stated)
        words += f" ({quantities}: {', '.join(places)})"
    return words


_PLACES = {"interior": "in the interior", "flank": "on a flank", "edge": "at an edge"}


def is_large(error: Mapping[str, Any] | str, names: Iterable[str]) -> bool:
    """Return whether one of the quantities is known to be off by more than 10 %.

    Contact at an edge carries its own flag: where situations were measured, the interior and
    flanks decide.
    """
    if isinstance(error, str):
        return False
    situations = error.get("situations") or {}
    smooth = [errors for place, errors in situations.items() if place != "edge"]
    return any(
        errors[name] > KNOWN_ERROR.notable_share for name in names for errors in smooth or [error]
    )
