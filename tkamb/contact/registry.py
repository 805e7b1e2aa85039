"""Contact models by name: built-in models and models of other packages.

A built-in model is one row of `BUILT_IN`. Another package offers a model through the entry-point
group `tkamb.contact`:

    [project.entry-points."tkamb.contact"]
    my-model = "my_package.my_module:MyModel"
"""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tkamb.contact.model import ContactModel
from tkamb.errors import InputError, must_be, names_near, real_number
from tkamb.named_classes import NamedClasses
from tkamb.units import MILLIMETRE

# m: largest accepted spacing. A condyle's contact is 5 to 20 mm across, and a
# coarser map does not resolve it.
COARSEST = 10.0 * MILLIMETRE
# m: default spacing, as `contact.resolution_mm` of a scene.
USUAL = 1.0 * MILLIMETRE


OPTION_RANGES = {"tolerance": (1e-9, 0.1), "patch_radius": (5e-4, 3e-2)}
"""Smallest and largest value of options. A smaller tolerance is below rounding; a larger one makes
pressures meaningless. Patches with a radius of 0.5 to 30 mm fit on a condyle."""

BUILT_IN = {
    "hertz": "tkamb.contact.hertz:Hertz",
    "foundation": "tkamb.contact.foundation:ElasticFoundation",
    "foundation-linear": "tkamb.contact.foundation:LinearFoundation",
    "lattice": "tkamb.contact.lattice.model:CalibratedLattice",
    "lattice-linear": "tkamb.contact.lattice.model:LinearLattice",
    "lattice-source": "tkamb.contact.lattice.source_lattice:SourceLattice",
    "fe": "tkamb.contact.lattice.model:FiniteElements",
}

CONTACT_MODELS = NamedClasses(
    "contact model",
    ContactModel,  # type: ignore[type-abstract]
    "tkamb.contact",
    BUILT_IN,
)


def contact_names() -> tuple[str, ...]:
    """Return the names of all contact models, built-in ones first."""
    return CONTACT_MODELS.names()


def contact_class(name: str) -> type[ContactModel]:
    """Return the class of a contact model."""
    return CONTACT_MODELS.find(name)


def contact_model(
    name: str,
    *,
    resolution: float = USUAL,
    **options: Any,
) -> ContactModel:
    """Return the contact model of a name.

    `resolution` is the spacing of the map points, m; `options` are other fields of the model's
    class (SI).

    Raises:
        InputError: the name, an option or the value of an option is unknown; the resolution is not
            positive or too coarse.
    """
    must_be(name, str, "contact model", f"give its name: {', '.join(contact_names())}")
    cls, where = contact_class(name), f"contact model '{name}'"
    resolution = real_number(resolution, f"{where}: resolution", "give it in metres")
    if not (math.isfinite(resolution) and 0 < resolution <= COARSEST):
        most = COARSEST
        hint = f"give more than 0, at most {most / MILLIMETRE:g} mm ({most:g} m)"
        raise InputError(f"resolution {resolution} m", where, hint)
    known_options = _options(cls)
    for option, value in options.items():
        if option not in known_options:
            raise InputError(f"has no option '{option}'", where, names_near(option, known_options))
        choices = _allowed_values(cls, option)
        if choices and value not in choices:
            advice = f"one of {', '.join(map(str, choices))}"
            raise InputError(f"option '{option}' cannot be {value!r}", where, advice)
        _check_kind(cls, option, value, where)
    return cls(resolution=resolution, **options)  # type: ignore[call-arg]


def contact_model_in_mm(
    name: str, resolution_mm: float, options: Mapping[str, Any]
) -> ContactModel:
    """Return the contact model of a scene or command, which states the spacing in mm."""
    if "resolution" in options:
        where = f"contact model '{name}'"
        raise InputError("resolution and resolution_mm are both given", where, "give one of them")
    return contact_model(name, resolution=resolution_mm * MILLIMETRE, **options)


def contact_options(name: str) -> tuple[str, ...]:
    """Return the names of a model's options without `resolution`."""
    return tuple(_options(contact_class(name)))


def _options(model: type[ContactModel]) -> list[str]:
    names = [field.name for field in fields(model) if field.init]  # type: ignore[arg-type]
    return [option for option in names if option != "resolution"]


def _allowed_values(model: type[ContactModel], option: str) -> tuple[Any, ...]:
    kind = get_type_hints(model)[option]
    return get_args(kind) if get_origin(kind) is Literal else ()


def _check_kind(model: type[ContactModel], option: str, value: Any, where: str) -> None:
    from pydantic import TypeAdapter, ValidationError

    low, high = OPTION_RANGES.get(option, (-math.inf, math.inf))
    is_number = isinstance(value, float | int) and not isinstance(value, bool)
    if is_number and not (math.isfinite(value) and low <= value <= high):
        is_option = option in OPTION_RANGES
        range_hint = f"give {low:g} to {high:g}" if is_option else "give a finite number"
        raise InputError(f"option '{option}' cannot be {value!r}", where, range_hint)
    kind = get_type_hints(model)[option]
    try:
        TypeAdapter(kind).validate_python(value, strict=True)
    except ValidationError:
        name = kind.__name__ if isinstance(kind, type) else str(kind)
        hint = f"give a value of type {name}"
        raise InputError(f"option '{option}' cannot be {value!r}", where, hint) from None


def contact_descriptions() -> dict[str, str]:
    """Return one line per model: its assumptions, its needs and its options.

    If a model cannot be loaded, its line is the error message.
    """
    lines = {}
    for name in contact_names():
        try:
            cls = contact_class(name)
            options = ", ".join(_options(cls)) or "none"
            lines[name] = f"assumes {cls.assumes}; needs {cls.needs}; options: {options}"
        except InputError as error:
            lines[name] = str(error)
    return lines
