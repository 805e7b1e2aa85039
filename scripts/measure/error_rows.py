"""Errors of the contact models on the pairs of `error_cases`.

The reference of a pair is the B-bar finite elements at cells of
`ERROR_REFERENCE.resolution_mm`. Its uncertainty is half the change from cells twice as large.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from error_cases import ErrorCase, error_cases
from tkamb.contact.flags import TOO_NARROW
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_class, contact_model
from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.show.tradeoff_report import bodies_of
from tkamb.studies.cases import study_case
from tkamb.studies.measures import Quantities, errors, quantities


@dataclass(frozen=True)
class ErrorReferenceSettings:
    """The reference of the known errors."""

    resolution_mm: float = 0.5
    """mm: resolution of the reference. Chosen because it is half of the finest compared one."""


ERROR_REFERENCE = ErrorReferenceSettings()

REFERENCE = "fe"
SETTINGS: dict[str, dict[str, tuple[float, ...]]] = {
    "polyethylene": {
        "lattice": (3.0, 2.0, 1.5, 1.0),
        "fe": (2.0, 1.5, 1.0),
        "lattice-linear": (2.0, 1.0),
        "foundation": (2.0, 1.0),
        "foundation-linear": (2.0, 1.0),
        "hertz": (1.0,),
    },
    "polyethylene-linear": {
        "lattice-linear": (2.0, 1.0),
        "fe": (2.0, 1.0),
        "foundation-linear": (2.0, 1.0),
    },
}
"""Material -> contact model -> measured resolutions, mm."""
RATIOS = Path(__file__).parents[1] / "data" / "known_error_ratios.json"
"""Result of `ratios`."""
COMPARED = ("approach", "mean_pressure", "peak_pressure", "area")


@dataclass(frozen=True)
class ErrorRow:
    """Errors of one setting on one pair.

    Args:
        case: name of the pair.
        situation: where the contact lies: interior, flank or edge.
        held_out: whether the case tests the stated errors; otherwise they are computed from it.
        material: name of the insert's material.
        contact: name of the contact model.
        resolution_mm: resolution of the pressure map, mm.
        status: status of the press, or "too narrow" after that flag; such contacts have
            no stated error.
        errors: relative errors of approach, mean and peak pressure and area; empty if the press
            failed.
        uncertainty: relative uncertainties of the reference.
    """

    case: str
    situation: str
    held_out: bool
    material: str
    contact: str
    resolution_mm: float
    status: str
    errors: dict[str, float]
    uncertainty: dict[str, float]


def settings() -> Iterator[tuple[str, str, float]]:
    """Yield material, model and resolution (mm), references first."""
    yield from ((material, REFERENCE, ERROR_REFERENCE.resolution_mm) for material in SETTINGS)
    for material, models in SETTINGS.items():
        yield from ((material, name, mm) for name, sizes in models.items() for mm in sizes)


def solved_key(case: ErrorCase, material: str, contact: str, resolution_mm: float) -> str:
    """Return the key of a solved setting."""
    return f"{case.name}|{contact}|{resolution_mm:g}|{material}"


def solve(case: ErrorCase, material: str, contact: str, resolution_mm: float) -> dict[str, Any]:
    """Return status, flags and quantities of a press."""
    keeps = "cache" in getattr(contact_class(contact), "__dataclass_fields__", {})
    model = contact_model(
        contact, resolution=resolution_mm * 1e-3, **({"cache": False} if keeps else {})
    )
    result = model.press(model.prepare(case.pair(material)), case.load, case.pose)
    return {"status": result.status.value, "flags": list(result.flags), **quantities(result)}


def error_rows(solved: Mapping[str, Mapping[str, Any]]) -> list[ErrorRow]:
    """Return the errors of all settings of which the setting and its reference are solved.

    Args:
        solved: `solved_key` -> result of `solve`.
    """
    result = []
    for case in error_cases():
        for material, models in SETTINGS.items():
            fine, coarse = (
                solved.get(
                    solved_key(case, material, REFERENCE, ERROR_REFERENCE.resolution_mm * factor)
                )
                for factor in (1, 2)
            )
            if fine is None or coarse is None or fine["status"] != "ok":
                continue
            reference = _quantities(fine)
            change = errors(_quantities(coarse), reference)
            uncertainty = {name: round(change[name] / 2, 5) for name in COMPARED}
            for name, sizes in models.items():
                for mm in sizes:
                    answer = solved.get(solved_key(case, material, name, mm))
                    if answer is not None:
                        result.append(
                            _row(case, material, name, mm, answer, reference, uncertainty)
                        )
    return result


def _row(
    case: ErrorCase,
    material: str,
    contact: str,
    resolution_mm: float,
    answer: Mapping[str, Any],
    reference: Quantities,
    uncertainty: dict[str, float],
) -> ErrorRow:
    status = str(answer["status"])
    if any(TOO_NARROW in flag for flag in answer.get("flags", ())):
        status = "too narrow"
    apart: dict[str, float] = {}
    if status == "ok":
        whole = errors(_quantities(answer), reference)
        apart = {name: round(whole[name], 5) for name in COMPARED}
    return ErrorRow(
        case.name, case.situation, case.held_out, material, contact, resolution_mm, status, apart,
        uncertainty,
    )  # fmt: skip


def _quantities(answer: Mapping[str, Any]) -> Quantities:
    return {k: v for k, v in answer.items() if k not in ("status", "flags", "sumF")}


def ratios() -> dict[str, list[float]]:
    """Return pair of bodies -> insert's thickness over the radius of contact, of each condyle.

    The contacts are those of the lattice at 1 mm. The cases are the pairs and the study's cases.
    """
    model = contact_model("lattice", resolution=1e-3, cache=False)
    found = {}
    for name, case in _every_case():
        result = model.press(model.prepare(case[0]), *case[1:])
        sides = [one for one in (result.medial, result.lateral) if one is not None]
        found[name] = [round(one.thickness_over_radius, 4) for one in sides]
    return found


def _every_case() -> Iterator[tuple[str, tuple[ContactPair, float, Array]]]:
    for case in error_cases():
        yield case.name, (case.pair(), case.load, case.pose)
    for name in ("sphere", "two condyles", "conforming", "knee 60 deg"):
        study = study_case(name)
        yield bodies_of(name), (study.pair, study.load, study.pose)


def rows_json(rows: list[ErrorRow]) -> str:
    """Return rows as JSON."""
    return json.dumps([asdict(row) for row in rows], indent=1, allow_nan=False) + "\n"


def read_error_rows(path: Path) -> list[ErrorRow]:
    """Read rows of a file.

    Raises:
        InputError: the file holds no rows.
    """
    try:
        return [ErrorRow(**row) for row in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"holds no errors of contact models ({error})", path, "run scripts/measure/known_errors"
        ) from None
