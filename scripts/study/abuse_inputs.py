"""Invalid inputs from a seed, with which `scripts/study/abuse` calls tkamb.

Each kind is a function (folder, chance) -> arguments of the command line. It writes its input into
the empty folder.
"""

import json
import os
import random
import shutil
import sys
import tempfile
import tomllib
from functools import cache
from pathlib import Path

MODEL = Path(__file__).resolve().parents[2] / "models" / "deep_knee_bend"
MESHES = ("femoral_component.stl", "insert.stl")
TABLES = ("motion.csv", "tibia.csv", "ground_reaction.csv")

NUMBERS = ["0", "-1", "1e308", "-1e-320", "nan", "inf", "1e9", "99999999999999999999", "0.5"]
WORDS = ["", " ", "é", "\x1b[31m", "\t", "true", "[]", "{}", "'", '"', "=", "../..", "/dev/zero",
         "\ud800", "a" * 5000, "%s%n", "${HOME}", "-", "--", "None", "\\"]  # fmt: skip
VALUES = ["0", "-1", "1e308", "nan", "inf", "true", "[]", "{}", '""', '"x"', "[1, 2]",
          "1979-05-27", "[[1]]", '"../../.."', '"/dev/zero"', '"/"', "99999999999999999999",
          "{a = 1}", '"\\u0000"']  # fmt: skip
RUN = ("--frames", "0:1")


def arguments(folder: Path, chance: random.Random) -> list[str]:
    """Return a valid command line with words changed, doubled, dropped or inserted."""
    commands = [
        ["run", str(MODEL / "scene.toml"), "--out", str(folder / "out"), *RUN],
        ["press", *(str(MODEL / name) for name in MESHES), "--load", "10", "--resolution", "9"],
        ["mesh", "check", str(MODEL / "insert.stl")],
        ["mesh", "lattice", str(MODEL / "insert.stl"), "--resolution", "9"],
        ["view", str(folder / "nothing"), "--port", "-1"],
        ["contact", "list"],
        ["scene", "--schema"],
        ["verify", str(folder)],
        ["report", str(folder)],
    ]
    given = list(chance.choice(commands))
    for _ in range(chance.randint(1, 3)):
        word = chance.choice([*NUMBERS, *WORDS, "--json", "--set", "--pose", "--axes", "--units"])
        place = chance.randint(0, len(given))
        how = chance.randint(0, 2)
        if how == 0 and place < len(given):
            given[place] = word
        elif how == 1 and place < len(given):
            del given[place]
        else:
            given.insert(place, word)
    return [word.encode("utf-8", "surrogatepass").decode("utf-8", "replace") for word in given]


def odd_files(folder: Path, chance: random.Random) -> list[str]:
    """Return a command line with a path that is no regular file."""
    path = folder / "odd.stl"
    kind = chance.randint(0, 6)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.mkdir()
    elif kind == 2:
        path.symlink_to(path)
    elif kind == 3:
        path = Path(chance.choice(["/dev/zero", "/dev/null", "/dev/tty", "/proc/self/mem"]))
    elif kind == 4:
        path = folder / ("n" * chance.choice([200, 255, 256, 5000]))
    elif kind == 5:
        path = folder / chance.choice(["a\0b", "\udcff\udcfe.toml", "new\nline"])
    else:
        os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), chance.choice([2**31, 2**40]))
    name, out = str(path), str(folder / "out")
    setting = f"{chance.choice(['patient.urdf', 'motion.file', 'implant.insert.mesh'])}={name}"
    return chance.choice(
        [
            ["run", name, "--out", out],
            ["run", str(MODEL / "scene.toml"), "--out", out, *RUN, "--set", setting],
            ["press", name, str(MODEL / MESHES[1]), "--load", "10"],
            ["press", *(str(MODEL / m) for m in MESHES), "--load", "1", "--pose-file", name],
            ["mesh", "check", name],
            ["mesh", "lattice", name, "--out", str(folder / "l.vtu")],
            ["verify", name],
            ["report", name],
            ["view", name, "--html", str(folder / "v.html")],
        ]
    )


def scenes(folder: Path, chance: random.Random) -> list[str]:
    """Write the shipped scene with other values of keys, missing lines or changed bytes."""
    scene = copied(folder) / "scene.toml"
    if chance.random() < 0.3:
        scene.write_bytes(spoilt(scene.read_bytes(), chance))
        return run(folder)
    content = tomllib.loads(scene.read_text(encoding="utf-8"))
    tables = [name for name, table in content.items() if isinstance(table, dict)]
    given = run(folder)
    for _ in range(chance.randint(1, 2)):
        table = chance.choice([*tables, "nothing", ""])
        key = chance.choice([*content.get(table, {"x": 1}), "x", ""])
        given += ["--set", f"{table}.{key}={chance.choice(VALUES)}"]
    return given


def tables(folder: Path, chance: random.Random) -> list[str]:
    """Write a recording with changed cells, rows, columns or bytes."""
    path = copied(folder) / chance.choice(TABLES)
    if chance.random() < 0.3:
        path.write_bytes(spoilt(path.read_bytes(), chance))
        return run(folder)
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    for _ in range(chance.randint(1, 4)):
        row = chance.choice(rows)
        how = chance.randint(0, 4)
        if how == 0:
            row[chance.randrange(len(row))] = chance.choice([*NUMBERS, *WORDS])
        elif how == 1:
            rows.remove(row)
        elif how == 2:
            rows.insert(chance.randrange(len(rows)), list(row))
        elif how == 3:
            row.append(chance.choice(NUMBERS))
        else:
            chance.shuffle(rows)
        rows = rows or [[""]]
        rows = [row or [""] for row in rows]
    text = "\n".join(",".join(row) for row in rows)
    path.write_text(text, encoding="utf-8", errors="replace")
    return run(folder)


def urdfs(folder: Path, chance: random.Random) -> list[str]:
    """Write a URDF with dropped, doubled or nested elements, or with changed numbers."""
    path = copied(folder) / "patient.urdf"
    text = path.read_text(encoding="utf-8")
    for _ in range(chance.randint(1, 3)):
        how, lines = chance.randint(0, 4), text.splitlines()
        if how == 0:
            path.write_bytes(spoilt(text.encode("utf-8", "surrogatepass"), chance))
            return run(folder)
        if how == 1:
            lines.pop(chance.randrange(len(lines)))
        elif how == 2:
            lines.insert(chance.randrange(len(lines)), chance.choice(lines))
        elif how == 3:
            number = chance.randrange(len(lines))
            parts = lines[number].split('"')
            parts[chance.randrange(len(parts))] = chance.choice([*NUMBERS, *WORDS, "0 0 0", "1 1"])
            lines[number] = '"'.join(parts)
        else:
            depth = chance.choice([50, 500, 50_000])
            lines.insert(chance.randrange(len(lines)), "<a>" * depth + "</a>" * depth)
        text = "\n".join(lines) or " "
    path.write_text(text, encoding="utf-8", errors="replace")
    return run(folder)


def meshes(folder: Path, chance: random.Random) -> list[str]:
    """Write a mesh that is cut short, has changed bytes, or another format than its suffix."""
    copied(folder)
    name = chance.choice(MESHES)
    path = folder / name
    content = path.read_bytes()
    how = chance.randint(0, 3)
    if how == 0:
        path.write_bytes(content[: chance.randrange(len(content))])
    elif how == 1:
        path.write_bytes(spoilt(content, chance))
    elif how == 2:
        count = chance.choice([0, 1, 2**32 - 1]).to_bytes(4, "little")
        path.write_bytes(content[:80] + count + content[84:])
    else:
        other = path.with_suffix(chance.choice([".obj", ".ply", ".off", ".glb", ".xyz", ""]))
        path.rename(other)
        path = other
    if chance.random() < 0.6:
        return ["mesh", "check", str(path)]
    files = [str(path if part == name else folder / part) for part in MESHES]
    return ["press", *files, "--load", "100", "--resolution", "5", "--contact", "foundation"]


def folders(folder: Path, chance: random.Random) -> list[str]:
    """Write a folder of results with changed, dropped, swapped or added files."""
    out = folder / "out"
    shutil.copytree(os.environ["TKAMB_ABUSE_RESULTS"], out)
    names = ["results.csv", "summary.json", "contact.h5", ".tkamb", ".tkamb-commit", ".frames"]
    for _ in range(chance.randint(1, 3)):
        path, how = out / chance.choice(names), chance.randint(0, 5)
        if how == 0 and path.is_file():
            path.write_bytes(spoilt(path.read_bytes(), chance))
        elif how == 1 and not path.is_dir():
            path.unlink(missing_ok=True)
        elif how == 2 and not path.exists():
            chance.choice([path.mkdir, path.touch, lambda p=path: os.mkfifo(p)])()
        elif how == 3 and not path.is_symlink() and not path.is_dir():
            path.unlink(missing_ok=True)
            path.symlink_to(chance.choice(["/dev/zero", "/", str(out / "results.csv")]))
        elif how == 4 and path.name == ".tkamb-commit" and not path.exists():
            journal = {"written": {chance.choice(WORDS): "x"}, "removed": [chance.choice(WORDS)]}
            path.write_text(json.dumps(journal))
        elif path.is_file():
            path.write_text(
                chance.choice(["{}", "[]", "[" * 99_999, "", "null", "time_s,status\n"])
            )
    scene = str(MODEL / "scene.toml")
    return chance.choice(
        [
            ["verify", str(out)],
            ["report", str(out)],
            ["run", scene, "--out", str(out), *RUN, "--contact", "foundation", "--resume"],
            ["view", str(out), "--html", str(folder / "v.html")],
        ]
    )


def toml(folder: Path, chance: random.Random) -> list[str]:
    """Write a short TOML text that is expensive to read: scene, material, springs or --set."""
    count = chance.choice([100, 5_000, 200_000, 2_000_000])
    key = chance.choice(["a", "contact.options.x", "motion", "material.table"])
    text = chance.choice(
        [
            f"{key}." + ".".join("a" * count) + " = 1",
            f"[{'.'.join('a' * count)}]",
            f"{key} = " + "1" * count,
            f"{key} = -0x" + "f" * count,
            f"{key} = " + "[" * count + "]" * count,
            f"{key} = " + "{a=" * count + "1" + "}" * count,
            f"{key} = 1e" + "9" * count,
            f'{key} = "' + "x" * count + '"',
            "\n".join(f"k{k} = 1" for k in range(min(count, 200_000))),
            "\n".join(f"[[a]]\n[a.b{k}]" for k in range(min(count, 100_000))),
            f"{key} = [" + "1," * count + "]",
            "#" * count,
        ]
    )
    path = folder / "given.toml"
    path.write_text(text, encoding="utf-8")
    scene, out = str(MODEL / "scene.toml"), str(folder / "out")
    return chance.choice(
        [
            ["run", str(path), "--out", out],
            ["check", str(path)],
            ["run", scene, "--out", out, *RUN, "--set", text.replace(" = ", "=", 1)[:100_000]],
            ["run", scene, "--out", out, *RUN, "--material", str(path)],
            ["wear", scene, "--material", str(path), "--out", out],
            ["wear", scene, "--simulator", str(MODEL / "motion.csv"), "--springs", str(path),
             "--out", out],
            ["cohort", str(path), "--out", out],
            ["press", *(str(MODEL / m) for m in MESHES), "--load", "1", "--material", str(path)],
        ]
    )  # fmt: skip


def options(folder: Path, chance: random.Random) -> list[str]:
    """Return a valid command line with odd values of one or two options.

    The folder `precious` holds another program's files, which must not change.
    """
    from tkamb.cli import _parser
    from tkamb.commands.options import leaf_parsers

    results, scene = os.environ["TKAMB_ABUSE_RESULTS"], str(MODEL / "scene.toml")
    precious = folder / PRECIOUS
    precious.mkdir()
    for name in PRECIOUS_NAMES:
        (precious / name).write_text(f"{PRECIOUS} {name}")
    meshes, out = [str(MODEL / name) for name in MESHES], str(folder / "out")
    bases = {
        "run": ["run", scene, *RUN, "--contact", "hertz", "--out", out],
        "press": ["press", *meshes, "--load", "9", "--resolution", "9", "--contact", "foundation"],
        "check": ["check", scene],
        "new": ["new", out],
        "mesh check": ["mesh", "check", meshes[1]],
        "mesh part": ["mesh", "part", meshes[1], "--out", str(folder / "part.stl")],
        "mesh lattice": ["mesh", "lattice", meshes[1], "--resolution", "9"],
        "export": ["export", results, "--vtp", "--out", out],
        "view": ["view", results, "--html", str(folder / "v.html")],
        "compare": ["compare", results, results, "--out", out],
        "wear": ["wear", results, "--cycles", "1", "--updates", "1", "--out", out],
        "uncertainty": ["uncertainty", scene, *RUN, "--contact", "hertz", "--screen"],
        "import": ["import", str(folder / "leg.osim"), "--motion", str(folder / "leg.mot"),
                   "--side", "right", "--mass-kg", "53.5", "--out", out],
        "verify": ["verify", results],
        "methods": ["methods", results],
        "scene": ["scene"],
        "settings": ["settings"],
        "contact list": ["contact", "list"],
    }  # fmt: skip
    command = chance.choice(sorted(bases))
    if command == "import":
        shutil.copytree(opensim_leg().name, folder, dirs_exist_ok=True)
    given = bases[command]
    actions = [a for a in dict(leaf_parsers(_parser()))[command]._actions if a.option_strings]
    places = [str(precious), *(str(precious / name) for name in PRECIOUS_NAMES), "/dev/full"]
    places += [
        str(folder / ("n" * 300)),
        str(folder / "new" / "er"),
        "/proc/x",
        "/",
        meshes[0],
        scene,
    ]
    for _ in range(chance.choice([1, 1, 2])):
        action = chance.choice(actions)
        names = {"--help", "--workers", "--dask", "--force"} & {*action.option_strings}
        if names:
            continue
        value = chance.choice([*NUMBERS, *WORDS, *places, *places, *(action.choices or ())])
        if action.option_strings[-1] in ("--out", "--html", "--sto"):
            value = chance.choice(places)
        value = str(value).encode("utf-8", "surrogatepass").decode("utf-8", "replace")
        given += [action.option_strings[-1]] + ([] if action.nargs == 0 else [value])
    return given


PRECIOUS = "precious"
PRECIOUS_NAMES = ("results.csv", "summary.json", "scene.toml", "patient.urdf", "insert.stl",
                  "made.vtu", "wear.json", "view.html", "a.sto", "a.inp", "a.json")  # fmt: skip


def opensim(folder: Path, chance: random.Random) -> list[str]:
    """Write an OpenSim model, motion or markers with changed lines, words or bytes, to import."""
    shutil.copytree(opensim_leg().name, folder, dirs_exist_ok=True)
    for _ in range(chance.choice([1, 1, 2])):
        path = folder / chance.choice(["leg.osim"] * 4 + ["leg.mot", "leg.trc"])
        content = path.read_bytes()
        path.write_bytes(
            spoilt(content, chance) if chance.random() < 0.3 else reworded(content, chance)
        )
    moved = chance.choice([["--motion", "leg.mot"], ["--motion", "leg.mot"], ["--trc", "leg.trc"]])
    given = ["import", str(folder / "leg.osim"), moved[0], str(folder / moved[1])]
    given += ["--side", "right", "--mass-kg", "53.5", "--out", str(folder / "out")]
    return given


@cache
def opensim_leg() -> tempfile.TemporaryDirectory:
    """Return a folder with a small leg, its motion and its markers."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
    import numpy as np

    from pendulum_leg import moving_leg, pendulum_osim
    from tkamb.io.opensim.read import read_osim
    from tkamb.show.storage import write_storage, write_trc

    held = tempfile.TemporaryDirectory(prefix="tkamb-leg-")
    osim = pendulum_osim(Path(held.name) / "leg.osim")
    q, markers = moving_leg(osim)
    time = np.arange(len(q)) / 60.0
    names = list(read_osim(osim).coordinates)
    columns = {"time": time} | {name: q[:, k] for k, name in enumerate(names)}
    write_storage(osim.with_suffix(".mot"), columns, in_degrees=False)
    write_trc(osim.with_suffix(".trc"), time, markers, 60.0)
    return held


def reworded(content: bytes, chance: random.Random) -> bytes:
    """Return a text with changed lines, or with changed words between brackets and blanks."""
    lines = content.decode("utf-8", "replace").splitlines() or [""]
    for _ in range(chance.randint(1, 4)):
        number, how = chance.randrange(len(lines)), chance.randint(0, 5)
        if how == 0:
            lines.pop(number)
        elif how == 1:
            lines.insert(number, chance.choice(lines))
        elif how == 2:
            lines.insert(chance.randrange(len(lines)), lines.pop(number))
        else:
            words = lines[number].replace("<", " <").replace(">", "> ").split(" ")
            words[chance.randrange(len(words))] = chance.choice(
                [
                    *NUMBERS,
                    *WORDS,
                    "0 0 0",
                    "ground",
                    "<a>",
                    "</a>",
                    "<!--",
                    "&amp;",
                    "NaN",
                    "knee_r",
                ]
            )
            lines[number] = " ".join(words)
        lines = lines or [""]
    return "\n".join(lines).encode("utf-8", "replace")


KINDS = {
    kind.__name__: kind
    for kind in (
        arguments, odd_files, scenes, tables, urdfs, meshes, folders, toml, opensim, options
    )
}  # fmt: skip


def copied(folder: Path) -> Path:
    """Copy the shipped patient into the folder."""
    shutil.copytree(MODEL, folder, dirs_exist_ok=True)
    return folder


def run(folder: Path) -> list[str]:
    """Return the arguments of a run of the folder's scene without contact, which is quick."""
    out = str(folder / "out")
    return ["run", str(folder / "scene.toml"), "--out", out, *RUN, "--contact", "hertz"]


def spoilt(content: bytes, chance: random.Random) -> bytes:
    """Return the bytes cut short, or with some bytes changed, doubled or inserted."""
    spoilt = bytearray(content)
    for _ in range(chance.choice([1, 1, 5, 50])):
        if not spoilt:
            break
        place, how = chance.randrange(len(spoilt)), chance.randint(0, 3)
        if how == 0:
            spoilt[place] ^= 1 << chance.randint(0, 7)
        elif how == 1:
            del spoilt[place : place + chance.choice([1, 100, len(spoilt)])]
        elif how == 2:
            spoilt[place:place] = bytes(chance.randrange(256) for _ in range(chance.randint(1, 9)))
        else:
            spoilt[place:place] = spoilt[place : place + 200]
    return bytes(spoilt)
