"""The shipped knee bend's recordings, copied and changed."""

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.studies.cases import SHIPPED_SCENE

NAMES = ("motion.csv", "tibia.csv", "ground_reaction.csv")


def copied_scene(folder: Path) -> Path:
    """Copy the shipped knee bend into a folder and return its scene file there."""
    shutil.copytree(SHIPPED_SCENE.parent, folder, dirs_exist_ok=True)
    return folder / SHIPPED_SCENE.name


def change_recording(path: Path, change: Callable[[list[str], Array], Array]) -> None:
    """Write a recorded table anew.

    Args:
        path: a .csv file.
        change: takes the columns' names and the rows (n, columns), returns the new rows.
    """
    with open(path, encoding="utf-8", newline="") as file:
        lines = list(csv.reader(file))
    rows = change(lines[0], np.array(lines[1:], float))
    with open(path, "w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([lines[0], *([repr(float(v)) for v in row] for row in rows)])


def thin_out(folder: Path, step: int) -> None:
    """Leave only every `step`-th row of the recordings in a folder."""
    for name in NAMES:
        change_recording(folder / name, lambda head, rows: rows[::step])


def stretch_time(folder: Path, scale: float) -> None:
    """Make the recordings in a folder take `scale` times as long."""

    def stretched(head: list[str], rows: Array) -> Array:
        rows[:, head.index("time_s")] *= scale
        return rows

    for name in NAMES:
        change_recording(folder / name, stretched)
