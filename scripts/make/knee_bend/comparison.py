"""Comparison of the shipped files with the files that the script makes.

Libraries of another platform may round the last digit differently. Therefore texts are equal when
their words are equal and their numbers differ by less than 2e-6 (mm, deg, N). Meshes are equal when
their corners differ by less than 1e-5 mm (a last digit in single precision).
"""

import re

import numpy as np

TEXT_TOLERANCE, MESH_TOLERANCE = 2e-6, 1e-5
NUMBER = re.compile(r"-?\d+\.\d+")
STL_HEADER, STL_RECORD = 84, 50


def differences(made, shipped):
    """Return one line per missing or different file."""
    found = []
    for path in sorted(made.iterdir()):
        other = shipped / path.name
        if not other.exists():
            found.append(f"{path.name}: is not shipped")
        elif path.read_bytes() != other.read_bytes():
            same = _same_mesh if path.suffix == ".stl" else _same_text
            if not same(path, other):
                found.append(f"{path.name}: differs")
    return found


def _same_text(one, other):
    texts = [path.read_text(encoding="utf-8") for path in (one, other)]
    words = [NUMBER.sub("#", text) for text in texts]
    numbers = [np.array(NUMBER.findall(text), float) for text in texts]
    if words[0] != words[1]:
        return False
    return bool(np.abs(numbers[0] - numbers[1]).max(initial=0.0) <= TEXT_TOLERANCE)


def _corners(path):
    data = np.frombuffer(path.read_bytes()[STL_HEADER:], np.uint8).reshape(-1, STL_RECORD)
    return np.ascontiguousarray(data[:, 12:48]).view("<f4")


def _same_mesh(one, other):
    if one.stat().st_size != other.stat().st_size:
        return False
    difference = _corners(one).astype(float) - _corners(other).astype(float)
    return bool(np.abs(difference).max() <= MESH_TOLERANCE)
