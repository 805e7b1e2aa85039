"""Forged folders of results from a seed, with correct hashes of wrong content."""

import hashlib
import json
import random
import shutil
from pathlib import Path

import h5py
import numpy as np

VALUES = [None, True, False, 0, -1, 1, 10**400, -(10**30), 1e308, 0.5, "", "x", "\x1b[31mred",
          "/etc/passwd", "a" * 10_000, [], {}, [[]], [None], ["x"], [1, 2], {"x": 1},
          {"words": None}, "none", "left", {"": []}, [{}], "../..", "\u202e"]  # fmt: skip
NUMBERS = [0.0, -1.0, 1e308, -1e308, np.nan, np.inf, 1e-320, 1e30]
SECRET = "somebody's own file, which no output may hold"


UNREADABLE = (OSError, KeyError, AttributeError, TypeError, ValueError, RuntimeError, MemoryError)
"""Errors of h5py on a forged array."""


def forge(folder: Path, results: Path, chance: random.Random) -> Path:
    """Copy a folder of results and change some of its content; return the copy."""
    out = folder / "out"
    shutil.copytree(results, out)
    for _ in range(chance.randint(1, 3)):
        chance.choice([_summary, _summary, _summary, _maps, _maps, _table])(out, chance)
    if chance.random() < 0.9:
        _rehash(out)
    return out


def _summary(out: Path, chance: random.Random) -> None:
    """Replace or remove a random value of summary.json."""
    path = out / "summary.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    places = [place for place in _places(content) if place]
    place = chance.choice(places)
    if chance.random() < 0.5:  # most readers use keys of the top level
        place = place[:1]
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    if chance.random() < 0.2:
        del inner[place[-1]]
    else:
        inner[place[-1]] = chance.choice(VALUES)
    extra = [
        "uncertainty",
        "measured",
        "emg",
        "reserves",
        "muscle_groups",
        "title",
        "cycle_percent_s",
    ]
    if chance.random() < 0.3:
        content[chance.choice(extra)] = chance.choice(VALUES)
    path.write_text(json.dumps(content), encoding="utf-8", errors="backslashreplace")


def _places(value: object, before: tuple = ()) -> list[tuple]:
    """Return the path of keys to each value in nested objects and lists."""
    found = [before]
    items = value.items() if isinstance(value, dict) else ()
    items = enumerate(value) if isinstance(value, list) else items
    for key, item in items:
        found += _places(item, (*before, key))
    return found


def _maps(out: Path, chance: random.Random) -> None:
    """Replace an array of contact.h5 by an array of another shape, type, value or location."""
    secret = out.parent / "secret.txt"
    secret.write_text(SECRET * 2000)
    with h5py.File(out / "contact.h5", "a") as file:
        name = chance.choice(sorted(file) or ["points_m"])
        try:
            old = np.zeros(1) if file[name].size > 10**6 else np.asarray(file[name][()], float)
        except UNREADABLE:  # forged before
            old = np.zeros(1)
        if name in file:
            del file[name]
        how = chance.randint(0, 11)
        if how == 0:
            return
        if how == 1:
            size = int(np.prod(old.shape)) * old.dtype.itemsize or 8
            files = [(str(secret), 0, size)]
            file.create_dataset(name, old.shape or (1,), old.dtype, external=files)
        elif how == 2:
            file[name] = h5py.ExternalLink(str(secret), "/x")
        elif how == 3:
            file[name] = h5py.SoftLink(chance.choice(["/nothing", "/points_m", f"/{name}"]))
        elif how == 4:
            layout = h5py.VirtualLayout(old.shape or (1,), "f8")
            layout[:] = h5py.VirtualSource(str(secret), "x", shape=old.shape or (1,))
            file.create_virtual_dataset(name, layout)
        elif how == 5:
            file.create_group(name)
        elif how == 6:
            shape = tuple(
                chance.choice([0, 1, 3, 7, 10**6, 10**9]) for _ in range(max(old.ndim, 1))
            )
            file.create_dataset(
                name, shape, "f8", maxshape=(None,) * len(shape), chunks=(1,) * len(shape)
            )
        elif how == 7:
            file[name] = chance.choice(["text", b"bytes", np.void(b"xx"), 1.0, h5py.Empty("f8")])
        elif how == 8:
            file[name] = old.astype(chance.choice(["c16", "?", "i1", "f2", "S3"]))
        elif how == 9 and old.size:
            old = old.astype(float)
            flat = old.reshape(-1)
            for _ in range(chance.choice([1, 5, old.size])):
                flat[chance.randrange(old.size)] = chance.choice(NUMBERS)
            file[name] = old
        elif how == 10:
            file[name] = np.full_like(old, chance.choice([0, -1, 10**9]))
        else:
            file[name] = old[: chance.choice([0, 1, 2])] if old.ndim else old
        if chance.random() < 0.3:
            file.attrs[chance.choice(["units", "model", "x"])] = chance.choice(
                [1, "\x1b", b"\xff", [1]]
            )


def _table(out: Path, chance: random.Random) -> None:
    """Change cells, columns or rows of results.csv."""
    path = out / "results.csv"
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    how = chance.randint(0, 4)
    if how == 0 and len(rows) > 1:
        for _ in range(chance.choice([1, 5, 100])):
            row = chance.choice(rows[1:])
            row[chance.randrange(len(row))] = chance.choice(
                ["", "nan", "inf", "-1e308", "1e308", "0", "x", "\x1b[31m", "1e30"]
            )
    elif how == 1:
        rows = rows[: chance.randint(1, len(rows))]
    elif how == 2:
        number = chance.randrange(len(rows[0]))
        rows = [row[:number] + row[number + 1 :] for row in rows]
    elif how == 3:
        number = chance.randrange(len(rows[0]))
        rows[1:] = [[*row[:number], "", *row[number + 1 :]] for row in rows[1:]]
    else:
        rows += [list(rows[-1])] * chance.choice([1, 50])
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")


def _rehash(out: Path) -> None:
    """Put the SHA-256 of the changed files into summary.json, as a forger would."""
    path = out / "summary.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(content.get("files"), dict):
        for name in ("results.csv", "contact.h5"):
            if (out / name).exists():
                content["files"][name] = hashlib.sha256((out / name).read_bytes()).hexdigest()
    content.pop("summary_sha256", None)
    text = json.dumps(content, sort_keys=True)
    content["summary_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(content), encoding="utf-8")
