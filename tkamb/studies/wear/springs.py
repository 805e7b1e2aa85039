"""Springs of a knee simulator that stand for the ligaments, from a file of the user's."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tkamb.errors import InputError, names_near
from tkamb.io.toml_text import read_toml
from tkamb.units import DEGREE, MILLIMETRE

KINDS = {
    "ap": ("stiffness_N_per_mm", "gap_mm", MILLIMETRE, 1e3, 30.0),
    "axial_rotation": ("stiffness_Nm_per_deg", "gap_deg", DEGREE, 50.0, 45.0),
}
"""Coordinate -> key of stiffness and of gap, unit, and the largest value of both."""


@dataclass(frozen=True)
class Spring:
    """A linear spring with a gap.

        force = -k sign(q) max(|q| - g, 0)

    Args:
        stiffness: k, N/m or N·m/rad.
        gap: g, m or rad: how far it goes either way before the spring is met.
    """

    stiffness: float
    gap: float


@dataclass(frozen=True)
class Springs:
    """The springs of a simulator.

    Args:
        springs: coordinate, "ap" or "axial_rotation", -> spring.
        sources: where the numbers come from.
        table: as the file gives them, in its units.
    """

    springs: Mapping[str, Spring]
    sources: tuple[str, ...]
    table: Mapping[str, Mapping[str, float]]


def read_springs(path: str | Path) -> Springs:
    """Read springs from a TOML file: [ap], [axial_rotation], either or both, and `sources`.

    Raises:
        InputError: an unknown or missing key, or a stiffness or gap that is none.
    """
    content = read_toml(path, what="springs")
    sources = content.pop("sources", None)
    if not (isinstance(sources, list) and sources and all(isinstance(s, str) for s in sources)):
        raise InputError("sources is not a list of texts", path, "say where each number comes from")
    if not content:
        raise InputError("has no spring", path, f"give {' or '.join(f'[{k}]' for k in KINDS)}")
    springs = {name: _spring(name, table, path) for name, table in content.items()}
    return Springs(springs, tuple(sources), content)


def _spring(name: str, table: Any, path: str | Path) -> Spring:
    if name not in KINDS:
        raise InputError(f"unknown key '{name}'", path, names_near(name, [*KINDS, "sources"]))
    stiffness, gap, unit, stiffest, widest = KINDS[name]
    if not isinstance(table, dict) or sorted(table) != sorted((stiffness, gap)):
        raise InputError(f"[{name}] is not complete", path, f"it needs: {stiffness}, {gap}")
    for key, least, most in ((stiffness, None, stiffest), (gap, 0.0, widest)):
        value = table[key]
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value) or value > most or value < (least or 0.0):
            raise InputError(f"cannot be {value}", f"{path}: [{name}] {key}", f"at most {most:g}")
        if least is None and value == 0:
            raise InputError("cannot be 0", f"{path}: [{name}] {key}", "leave the table out")
    return Spring(float(table[stiffness]) / unit, float(table[gap]) * unit)
