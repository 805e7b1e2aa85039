"""Helpers that damage the bytes of a recording at random, and read the damaged file."""

import random
import warnings
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.io.importing.plates import table_forces
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.recordings.tables import read_table

WORDS = [b"\x00", b"\xff", b"\x7f", b"\x80", b"\x01", b"\x00\x00\x80\x7f", b"\xff\xff\xff\x7f"]
TEXTS = [b"", b" ", b"\t\t", b",", b"1e308", b"nan", b"-", b"\n", b"\x00", b"\xe9", b"9" * 400]
HEAD = 4096
"""bytes: size of a C3D's header and parameters, where most of the damage is."""


def damaged(content: bytes, seed: int, words: list[bytes] = WORDS) -> bytes:
    """Return the content with one to three random changes, insertions, deletions or cuts."""
    chance = random.Random(seed)
    broken = bytearray(content)
    for _ in range(chance.randint(1, 3)):
        head = min(HEAD, len(broken)) if chance.random() < 0.8 else len(broken)
        at = chance.randrange(max(head, 1))
        how = chance.random()
        word = chance.choice(words)
        if how < 0.5:
            broken[at : at + 1] = bytes([chance.randrange(256)])
        elif how < 0.8:
            broken[at : at + len(word)] = word
        elif how < 0.9:
            broken[at:at] = word
        elif how < 0.97:
            del broken[at : at + chance.randint(1, 600)]
        else:
            del broken[at:]
    return bytes(broken)


def read_all(path: Path) -> str:
    """Read a whole recording, and return "read" or the error message.

    Raises:
        AssertionError: a value is infinite, or the message has several lines.
    """
    parts = [lambda: read_table(path)]
    if path.suffix == ".c3d":
        parts.append(lambda: read_c3d(path))
    else:
        parts.append(lambda: table_forces(read_table(path)))
    message = "read"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for part in parts:
            try:
                content = part()
            except InputError as error:
                message = str(error)
                continue
            if path.suffix == ".c3d" and hasattr(content, "plates"):
                for plate in content.plates:
                    assert not np.isinf(plate.wrench).any()
                assert not np.isinf(content.points).any()
                assert len(content.time) == len(content.points)
    assert "\n" not in message
    return message
