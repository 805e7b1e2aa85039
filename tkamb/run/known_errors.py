"""Known errors of the contact models, and their limits for mobile bearings.

An error is relative to a converged reference. The stored value is the largest error over the
measured cases. It is no bound for other cases. The cases are those of the trade-off study and
half of the pairs of bodies of `scripts/measure/error_cases.py`. The other half is held out. It
tests the share of new errors below the stored ones (docs/known_errors.md).
`scripts/make/tradeoff_table` writes `run/known_errors.json`. Errors of other settings are not
interpolated but reported as "not measured".
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
    """1: relative error above which a known error is coloured. Chosen because such an error may
    change a conclusion."""


KNOWN_ERROR = KnownErrorSettings()

NOT_MEASURED = "not measured"
SAME_ANSWER = ("cache",)
"""Options that change the computing time of a result, but not the result."""


@dataclass(frozen=True)
class KnownError:
    """Largest relative errors of one setting.

    Args:
        approach: error of the approach.
        force: error of a condyle's force, relative to the load; None: no case has two condyles.
        mean_pressure: error of a condyle's mean pressure.
        peak_pressure: error of a condyle's peak pressure.
        area: error of a condyle's contact area.
        cases: number of measured cases.
        situations: place of the contact ("interior", "flank", "edge") -> quantity -> largest error
            at that place. Contacts with a flag that is not about the edge are excluded.
        covered: share of the errors on held-out pairs below the stored errors; None: no pair was
            held out.
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
    """Return the label of a setting in the trade-off study: name and options of the model."""
    text = ",".join(f"{key}={value}" for key, value in options.items() if key not in SAME_ANSWER)
    return f"{model}[{text}]" if text else model


@cache
def known_errors() -> dict[tuple[str, float, str], KnownError]:
    """Return (label, resolution in mm, name of the material) -> known error."""
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
    """Return the known error of a setting; None: not measured.

    Args:
        model: name of the contact model. Plug-ins were not measured.
        resolution_mm: spacing of the map points, mm. Only the spacings of the study were measured.
        material: material of the insert. Polyethylene and polyethylene-linear were measured.
        options: options of the contact model.
    """
    label = setting_label(model, options or {})
    return known_errors().get((label, float(resolution_mm), material))


def outside_measured(flags: Iterable[str]) -> bool:
    """Return whether a contact's flags name a defect or a support that no measured case has."""
    from tkamb.contact.flags import MESH_DEFECT, UNSUPPORTED  # only where contact is modelled

    return any(words in flag for flag in flags for words in (MESH_DEFECT, UNSUPPORTED))


def left_out(model: str, bearing: str) -> tuple[str, ...]:
    """Return sentences on features of a bearing ("fixed", "mobile") that a contact model lacks."""
    from tkamb.contact.registry import contact_class  # only where contact is modelled

    if bearing == "fixed" or contact_class(model).mobile_bearing:
        return ()
    return (f"The bearing is mobile, but {model} computes it as a fixed one.",)


def as_json(error: KnownError | None) -> dict[str, Any] | str:
    """Return the value of the key `known_error` in summary.json and `tkamb press --json`."""
    return NOT_MEASURED if error is None else asdict(error)


def known_error_words(error: Mapping[str, Any] | str, names: Iterable[str]) -> str:
    """Return full sentences on the known errors of some quantities.

    Args:
        error: value of the key `known_error` in summary.json.
        names: quantities, fields of `KnownError`.
    """
    if isinstance(error, str):
        return f"The error of this setting of the contact model is {error}."
    names = list(names)
    words = (
        f"In {error['cases']} reference cases the error of the contact model was at most "
        f"{_listed(error, names)}."
    )
    stated = [name for name in names if name in ("peak_pressure", "area")]
    places = [
        f"{_PLACES[place]} {_listed(errors, stated)}"
        for place, errors in (error.get("situations") or {}).items()
    ]
    if stated and places:
        words += f" By the place of the contact it was at most: {'; '.join(places)}."
    return words


def short_error_words(error: Mapping[str, Any] | str, names: Iterable[str]) -> str:
    """Return one sentence on the known errors that refers to the report's conclusions.

    Args:
        error: value of the key `known_error` in summary.json.
        names: quantities, fields of `KnownError`.
    """
    if isinstance(error, str):
        return known_error_words(error, names)
    return (
        "In reference cases the error of the contact model alone was at most "
        f"{_listed(error, names)}: see the report's conclusions."
    )


def _listed(errors: Mapping[str, Any], names: Iterable[str]) -> str:
    """Return errors in words, for example "5 % of the peak pressure and 3 % of the area"."""
    parts = [f"{100 * errors[name]:.2g} % of the {name.replace('_', ' ')}" for name in names]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


_PLACES = {"interior": "in the interior", "flank": "on a flank", "edge": "at an edge"}


def is_large(error: Mapping[str, Any] | str, names: Iterable[str]) -> bool:
    """Return whether the known error of any of the quantities exceeds `notable_share`.

    Contact at an edge has a flag of its own. Where situations were measured, only interior and
    flanks count.
    """
    if isinstance(error, str):
        return False
    situations = error.get("situations") or {}
    smooth = [errors for place, errors in situations.items() if place != "edge"]
    return any(
        errors[name] > KNOWN_ERROR.notable_share for name in names for errors in smooth or [error]
    )
