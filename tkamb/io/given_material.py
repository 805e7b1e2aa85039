"""A material from the table [material] of a scene, or from a file with the same keys."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.materials import (
    MATERIALS,
    LinearElastic,
    Material,
    RambergOsgood,
    StressStrainLaw,
    TabulatedLaw,
    material,
)
from tkamb.errors import InputError, names_near
from tkamb.io.toml_text import read_toml
from tkamb.units import MEGAPASCAL

KEYS = (
    *("base", "name", "young_modulus_MPa", "poisson_ratio", "yield_stress_MPa", "law", "alpha"),
    *("reference_stress_MPa", "exponent", "strain", "stress_MPa", "sources"),
)
LAW_KEYS = {
    "linear": (),
    "ramberg-osgood": ("alpha", "reference_stress_MPa", "exponent"),
    "tabulated": ("strain", "stress_MPa"),
}
"""Name of a stress–strain law -> its required keys."""
NUMBERS = (
    *("young_modulus_MPa", "poisson_ratio", "yield_stress_MPa", "alpha"),
    *("reference_stress_MPa", "exponent"),
)
EXAMPLE = "see docs/materials.md"


def given_material(table: Mapping[str, Any], where: object = "[material]") -> Material:
    """Return the material that a table with the keys `KEYS` describes.

    With only `base` it is that built-in material, whose values further keys replace. Without
    `base`, it needs Young's modulus, Poisson's ratio and the numbers of its law. Young's modulus of
    a tabulated curve is its slope at the origin, to which `young_modulus_MPa` scales the curve if
    given.

    Args:
        table: keys of docs/materials.md; a key with value None is ignored.

    Raises:
        InputError: a key is unknown, missing or superfluous, or a value is out of range.
    """
    entries = {key: value for key, value in table.items() if value is not None and value != ()}
    for key in entries:
        if key not in KEYS:
            raise InputError(f"unknown key '{key}'", where, names_near(key, KEYS))
    for key in NUMBERS:
        value = entries.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"cannot be {value!r}", f"{where}: {key}", "give a number")
    base = None if "base" not in entries else material(entries["base"])
    if base is not None and set(entries) == {"base"}:
        return base
    _check_name(entries, where)
    law = _law(entries, base, where)
    modulus = entries.get("young_modulus_MPa")
    if modulus is not None:
        modulus *= MEGAPASCAL
    elif isinstance(law, TabulatedLaw) and "strain" in entries:
        modulus = law.young_modulus
    elif base is not None:
        modulus = base.young_modulus
    else:
        raise InputError("'young_modulus_MPa' is missing", where, EXAMPLE)
    ratio = entries.get("poisson_ratio", None if base is None else base.poisson_ratio)
    if ratio is None:
        raise InputError("'poisson_ratio' is missing", where, "UHMWPE has about 0.45")
    sources = tuple(entries.get("sources", ()))
    if base is not None:
        sources += tuple(f"{base.name}: {source}" for source in base.sources)
    name = entries.get("name") or ("own" if base is None else f"{base.name} (changed)")
    return replace(Material(name, float(modulus), float(ratio), law), sources=sources)


def named_material(name: str | Path | Material) -> Material:
    """Return a material by its name or file.

    Args:
        name: key of `MATERIALS`, path of a .toml file with the keys of [material], or a material,
            which is returned unchanged.

    Raises:
        InputError: the material or file does not exist, or the file does not describe a material.
    """
    if isinstance(name, Material):
        return name
    if Path(name).suffix != ".toml":
        return material(str(name))
    content = read_toml(name, what="material")
    inner = content.get("material")
    if isinstance(inner, dict) and len(content) == 1:
        content = inner
    content.setdefault("name", Path(name).stem)
    return given_material(content, name)


def material_as_json(chosen: Material) -> dict[str, Any]:
    """Return all numbers of a material (stresses in MPa) and their sources."""
    law = chosen.law
    curve: dict[str, Any] = {"law": type(law).__name__}
    if chosen.is_linear:
        curve = {"law": "linear"}
    elif type(law) is RambergOsgood:
        curve = {
            "law": "ramberg-osgood",
            "alpha": law.alpha,
            "reference_stress_MPa": law.reference_stress / MEGAPASCAL,
            "exponent": law.exponent,
        }
    elif type(law) is TabulatedLaw:
        scale = chosen.young_modulus / law.young_modulus / MEGAPASCAL
        curve = {
            "law": "tabulated",
            "strain": list(law.strain),
            "stress_MPa": [value * scale for value in law.values],
        }
    return {
        "name": chosen.name,
        "young_modulus_MPa": chosen.young_modulus / MEGAPASCAL,
        "poisson_ratio": chosen.poisson_ratio,
        **curve,
        "sources": list(chosen.sources),
    }


def material_in_words(values: Mapping[str, Any]) -> str:
    """Return one line of text on a material from the result of `material_as_json`."""
    parts = [
        f"E = {values['young_modulus_MPa']:.4g} MPa",
        f"Poisson's ratio {values['poisson_ratio']:.3g}",
    ]
    if values["law"] == "ramberg-osgood":
        parts.append(
            f"Ramberg-Osgood, alpha {values['alpha']:.4g}, reference stress "
            f"{values['reference_stress_MPa']:.5g} MPa, exponent {values['exponent']:.5g}"
        )
    elif values["law"] == "tabulated":
        parts.append(
            f"tabulated curve of {len(values['strain'])} points to {values['strain'][-1]:.3g} "
            f"strain and {values['stress_MPa'][-1]:.4g} MPa"
        )
    else:
        parts.append(values["law"])
    sources = "; ".join(values["sources"]) or "no source given"
    return f"{values['name']}: {', '.join(parts)} ({sources})"


def _check_name(entries: Mapping[str, Any], where: object) -> None:
    name = entries.get("name")
    if name in MATERIALS:
        what = f"'{name}' is the name of a built-in material"
        raise InputError(what, where, "choose another name, so that results show the material")


def _law(entries: Mapping[str, Any], base: Material | None, where: object) -> StressStrainLaw:
    name = entries.get("law")
    if name is not None and name not in LAW_KEYS:
        raise InputError(f"no law '{name}'", where, names_near(str(name), LAW_KEYS))
    base_law = base.law if base is not None else None
    if name is None and isinstance(base_law, RambergOsgood):
        name = "ramberg-osgood"
    name = name or "linear"
    values = {key: entries[key] for keys in LAW_KEYS.values() for key in keys if key in entries}
    if name == "ramberg-osgood" and isinstance(base_law, RambergOsgood):
        values = {
            "alpha": base_law.alpha,
            "reference_stress_MPa": base_law.reference_stress / MEGAPASCAL,
            "exponent": base_law.exponent,
        } | values
    for key in values:
        if key not in LAW_KEYS[name]:
            needs = ", ".join(LAW_KEYS[name]) or "no numbers"
            raise InputError(
                f"'{key}' is not a key of the law '{name}'", where, f"it takes: {needs}"
            )
    for key in LAW_KEYS[name]:
        if key not in values:
            raise InputError(f"law '{name}' needs '{key}'", where, EXAMPLE)
    if name == "linear":
        return LinearElastic()
    try:
        if name == "ramberg-osgood":
            stress = float(values["reference_stress_MPa"]) * MEGAPASCAL
            return RambergOsgood(float(values["alpha"]), stress, float(values["exponent"]))
        strain, stress_MPa = (np.asarray(values[key], float) for key in LAW_KEYS["tabulated"])
        return TabulatedLaw(tuple(strain.tolist()), tuple((stress_MPa * MEGAPASCAL).tolist()))
    except InputError as error:
        raise InputError(error.what, where, error.hint) from None
    except (TypeError, ValueError):
        raise InputError("strain and stress_MPa are not lists of numbers", where, EXAMPLE) from None
