"""Random mistakes in input files: single cells, columns, scene keys, URDF edits.

A mistake is for example a factor of ten, a sign, a unit, an axis, a neighbouring column or a
misspelt word. It changes a position by at least 30 mm, an angle by 6 deg or a force by a tenth of
the peak. A smaller change could be another patient, so no program can detect it.
"""

import xml.etree.ElementTree as ElementTree

import numpy as np

from mistakes import cells_of, set_key, text_of

LEAST = {"deg": 6.0, "mm": 30.0, "m": 0.03, "rad": 0.1, "N": 0.1}
"""Unit -> smallest change that is a mistake. Forces: as a share of their peak."""


def random_mistakes(bench, rng, urdf, others):
    """Return (name, edit) of random edits.

    Args:
        bench: scene to edit.
        rng: random generator.
        urdf: number of edits of the URDF.
        others: number of edits of tables and scene keys.
    """
    kinds = [("urdf", urdf_edit)] * urdf
    kinds += [(("cell", cell_edit), ("column", column_edit), ("key", key_edit))[k % 3]
              for k in range(others)]  # fmt: skip
    edits = []
    for kind, make in kinds:
        name, edit = make(bench, np.random.default_rng(rng.integers(2**63)))
        edits.append((f"{kind}: {name}", edit))
    return edits


def pick(rng, items):
    """Return one of the items."""
    items = list(items)
    return items[rng.integers(len(items))]


# URDF


def urdf_edit(bench, rng):
    """Return name and function of a random edit of the URDF."""
    text = bench.texts["patient.urdf"]
    while True:
        robot = ElementTree.fromstring(text)
        name = pick(rng, URDF_EDITS)(robot, rng)
        if name is not None:
            changed = ElementTree.tostring(robot, encoding="unicode")
            return name, lambda content, texts, c=changed: texts.update({"patient.urdf": c})


def _joint(robot, rng, prefix=("knee_", "patella_")):
    return pick(rng, [j for j in robot.findall("joint") if _moves(j, prefix)])


def _moves(joint, prefix):
    return joint.get("name").startswith(prefix) and joint.get("type") != "fixed"


def _kind(robot, rng):
    joint = pick(rng, robot.findall("joint"))
    if joint.get("name") == "ankle":
        return None
    kinds = {"revolute", "continuous", "prismatic", "fixed", "floating"} - {joint.get("type")}
    joint.set("type", pick(rng, sorted(kinds)))
    return f"{joint.get('name')} is {joint.get('type')}"


def _axis(robot, rng):
    joint = _joint(robot, rng)
    axis = joint.find("axis")
    values = axis.get("xyz").split()
    turned = pick(rng, (np.roll(values, 1), [str(-float(v)) for v in values]))
    axis.set("xyz", " ".join(turned))
    return f"{joint.get('name')} about {axis.get('xyz')}"


def _inner_origin(robot, rng):
    joint = _joint(robot, rng)
    if joint.get("name") in ("knee_ap", "patella_ap"):
        return None
    key, size = pick(rng, (("xyz", 1e-2), ("rpy", 0.3)))
    joint.find("origin").set(key, " ".join(f"{v:.5f}" for v in rng.uniform(-size, size, 3)))
    return f"{joint.get('name')} {key}={joint.find('origin').get(key)}"


def _place(robot, rng):
    """Change the origin of knee_ap or of a fixed joint by a sign, a factor or a permutation."""
    joint = pick(rng, [j for j in robot.findall("joint") if j.get("name") == "knee_ap"
                       or j.get("type") == "fixed"])  # fmt: skip
    origin = joint.find("origin")
    old = np.array(origin.get("xyz").split(), float)
    k = rng.integers(3)
    new = old.copy()
    how = pick(rng, ("sign", "ten", "tenth", "mm", "inch", "roll"))
    if how == "sign":
        new[k] = -old[k]
    elif how == "roll":
        new = np.roll(old, 1)
    else:
        new = old * {"ten": 10.0, "tenth": 0.1, "mm": 1000.0, "inch": 1 / 0.0254}[how]
    if np.linalg.norm(new - old) < LEAST["m"]:
        return None
    origin.set("xyz", " ".join(repr(float(v)) for v in new))
    return f"{joint.get('name')} origin {how} {new.round(4)}"


def _turned_place(robot, rng):
    joint = pick(rng, [j for j in robot.findall("joint") if j.get("name") == "knee_ap"])
    old = np.array(joint.find("origin").get("rpy", "0 0 0").split(), float)
    new = old.copy()
    new[rng.integers(3)] += pick(rng, (-1, 1)) * pick(rng, (0.5, np.pi / 2, np.pi))
    joint.find("origin").set("rpy", " ".join(repr(float(v)) for v in new))
    return f"{joint.get('name')} rpy {new.round(3)}"


def _limit(robot, rng):
    joint = _joint(robot, rng)
    limit = joint.find("limit")
    how = pick(rng, ("none", "lower", "effort", "word", "wide"))
    if how == "none":
        joint.remove(limit)
    elif how == "word":
        limit.set("upper", "many")
    elif how == "wide":
        limit.set("upper", "100.0")
    else:
        del limit.attrib[how]
    return f"{joint.get('name')} limit {how}"


def _mass(robot, rng):
    mass = pick(rng, list(robot.iter("mass")))
    factor = pick(rng, (2.2046, 1000.0, 1e-3, -1.0, 0.1, 10.0))
    mass.set("value", repr(float(mass.get("value")) * factor))
    return f"mass × {factor}"


def _inertia(robot, rng):
    tensor = pick(rng, list(robot.iter("inertia")))
    key = pick(rng, ("ixx", "iyy", "izz", "ixy"))
    how = pick(rng, ("none", "thousand", "all", "negative", "word"))
    if how == "none":
        del tensor.attrib[key]
    elif how == "thousand":
        tensor.set(key, repr(1000.0 * float(tensor.get(key)) + 1.0))
    elif how == "negative":
        tensor.set("ixx", repr(-float(tensor.get("ixx"))))
    elif how == "word":
        tensor.set(key, "0.1.2")
    else:
        factor = pick(rng, (1e-4, 1e4, 1e6))
        for name, value in list(tensor.attrib.items()):
            tensor.set(name, repr(float(value) * factor))
    return f"inertia {key} {how}"


def _centre(robot, rng):
    link = pick(rng, [n for n in robot.findall("link") if n.find("inertial/origin") is not None])
    origin = link.find("inertial/origin")
    old = np.array(origin.get("xyz").split(), float)
    new = pick(rng, (-old, 10 * old, 0.1 * old, 1000 * old, np.roll(old, 1)))
    if np.linalg.norm(new - old) < LEAST["m"]:
        return None
    origin.set("xyz", " ".join(repr(float(v)) for v in new))
    return f"centre of {link.get('name')} {new.round(3)}"


def _inner_mass(robot, rng):
    link = pick(rng, [n for n in robot.findall("link") if n.get("name").endswith("_link")])
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value=repr(float(rng.uniform(0.1, 3.0))))
    terms = dict.fromkeys(("ixx", "iyy", "izz"), "0.01") | dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    ElementTree.SubElement(inertial, "inertia", terms)
    return f"mass on {link.get('name')}"


def _order(robot, rng):
    """Exchange the positions of two joints in the chain."""
    prefix = pick(rng, ("knee_", "patella_"))
    joints = [j for j in robot.findall("joint") if _moves(j, prefix)]
    one, other = (joints[k] for k in rng.choice(len(joints), 2, replace=False))
    one_name, other_name = one.get("name"), other.get("name")
    one.set("name", other_name)
    other.set("name", one_name)
    a, b = one.find("axis"), other.find("axis")
    a.attrib, b.attrib = dict(b.attrib), dict(a.attrib)
    one_kind, other_kind = one.get("type"), other.get("type")
    one.set("type", other_kind)
    other.set("type", one_kind)
    return f"{one_name} and {other_name} exchanged"


def _word(robot, rng):
    """Misspell a name, an element or an attribute."""
    element = pick(rng, [e for e in robot.iter() if e.tag != "robot"])
    how = pick(rng, ("tag", "attribute", "value"))
    if how == "tag":
        element.tag = _misspelt(element.tag, rng)
        return f"<{element.tag}>"
    if not element.attrib:
        return None
    key = pick(rng, sorted(element.attrib))
    if how == "attribute":
        element.attrib = {(_misspelt(k, rng) if k == key else k): v
                          for k, v in element.attrib.items()}  # fmt: skip
    elif element.get(key).replace("_", "").isalpha():
        element.set(key, _misspelt(element.get(key), rng))
    else:
        element.set(key, pick(rng, ("", "nan", "1 2", "x", "1,5 0 0")))
    return f"<{element.tag} {element.attrib}>"


def _misspelt(word, rng):
    k = int(rng.integers(len(word)))
    return word[:k] + word[k + 1 :] if len(word) > 3 else word + "s"


def _ends(robot, rng):
    """Give a joint another parent or child."""
    joint = pick(rng, robot.findall("joint"))
    end = joint.find(pick(rng, ("parent", "child")))
    links = {link.get("name") for link in robot.findall("link")} - {end.get("link")}
    end.set("link", pick(rng, sorted(links)))
    return f"{joint.get('name')} {end.tag} is {end.get('link')}"


def _removed(robot, rng):
    parent = pick(rng, [e for e in robot.iter() if len(e)])
    child = pick(rng, list(parent))
    if child.tag == "inertial":
        return None  # absent, it has a documented default
    place = np.array(child.get("xyz", "1 1 1").split(), float)
    if child.tag == "origin" and "rpy" not in child.attrib and np.linalg.norm(place) < LEAST["m"]:
        return None  # absent, it is zero
    parent.remove(child)
    return f"without {child.tag} {child.attrib} of {parent.get('name')}"


def _doubled(robot, rng):
    parent = pick(rng, [e for e in robot.iter() if len(e)])
    child = pick(rng, list(parent))
    parent.append(child)
    return f"{child.tag} {child.attrib} twice"


URDF_EDITS = (
    _kind, _axis, _inner_origin, _place, _turned_place, _limit, _mass, _inertia, _centre,
    _inner_mass, _order, _word, _ends, _removed, _doubled,
)  # fmt: skip


# Tables


def _table(bench, rng):
    """Return the name of a random table, its rows, index of the first data row, and separator."""
    name = pick(rng, [n for n in sorted(bench.texts) if n.endswith((".csv", ".sto"))])
    separator = "," if name.endswith(".csv") else "\t"
    rows = cells_of(bench.texts[name], separator)
    start = next(k for k, row in enumerate(rows) if any("time" in c.lower() for c in row)) + 1
    return name, rows, start, separator


def _used(bench, name, header):
    """Return index -> unit of the columns that the scene uses, without time."""
    table = next(t for t in bench.content.values() if isinstance(t, dict) and t.get("file") == name)
    roles = {column: role for role, column in table.get("columns", {}).items()}
    angle, length = table.get("angle_unit", "deg"), table.get("length_unit", "mm")
    units = {}
    for k, column in enumerate(header):
        role = roles.get(column, column)
        if role.startswith("force"):
            units[k] = "N"
        elif role.startswith(("point", "translation")) or role.rsplit("_")[-1] in (
            "ap",
            "si",
            "ml",
        ):
            units[k] = length
        elif role.startswith(("rotation", "angle")) or role in ROTATIONS:
            units[k] = angle
    return units


ROTATIONS = ("flexion", "adduction", "axial_rotation", "patella_rotation")


def _rows_in_use(bench, name, rows, start):
    """Return the indices of data rows; of a force plate, of loaded rows within the cycle."""
    content = bench.content
    if name != content.get("ground_reaction", {}).get("file"):
        return list(range(start, len(rows)))
    up = rows[start - 1].index(content["ground_reaction"]["columns"]["force_2"])
    inside = content["motion"].get("cycle_s", (-1.0, 1e9))
    return [
        k
        for k in range(start, len(rows))
        if float(rows[k][up]) > 200 and inside[0] <= float(rows[k][0]) <= inside[1]
    ]


def _is_mistake(old, new, unit, peak):
    least = LEAST[unit] * (peak if unit == "N" else 1.0)
    return abs(new - old) >= least


def cell_edit(bench, rng):
    """Return a random edit of one cell."""
    while True:
        name, rows, start, separator = _table(bench, rng)
        units = _used(bench, name, rows[start - 1])
        k, column = pick(rng, _rows_in_use(bench, name, rows, start)), pick(rng, units)
        old = float(rows[k][column])
        peak = max(abs(float(row[column])) for row in rows[start:])
        how = pick(rng, CELLS)
        text = how(old, units[column]) if callable(how) else how
        try:
            if not _is_mistake(old, float(text), units[column], peak):
                continue
        except ValueError:
            pass
        rows[k][column] = text
        changed = text_of(rows, separator)
        return (
            f"{name} row {k - start + 1} {rows[start - 1][column]}: {old} -> {text}",
            lambda content, texts, n=name, c=changed: texts.update({n: c}),
        )


CELLS = (
    lambda v, unit: repr(-v),
    lambda v, unit: repr(10 * v),
    lambda v, unit: repr(0.1 * v),
    lambda v, unit: repr(1000 * v),
    lambda v, unit: repr(v + (2 * np.pi if unit == "rad" else 360)),
    "1e308", "1e5", "1_000", "", "nan", "inf", "abc", "1;5", "٣", "0x10", "210", "-1e9", "0",
)  # fmt: skip


def column_edit(bench, rng):
    """Return a random edit of a whole column, or of two."""
    while True:
        name, rows, start, separator = _table(bench, rng)
        header = rows[start - 1]
        units = _used(bench, name, header)
        values = np.array([[float(c) for c in row] for row in rows[start:]])
        column = pick(rng, units)
        how, factor = pick(rng, COLUMNS[units[column]])
        new = values[:, column] * factor
        text = f"{name} {header[column]} {how}"
        other = None
        if how == "exchanged":
            other = pick(rng, units)
            new = values[:, other]
            text += f" with {header[other]}"
        if how == "time":
            column, new = 0, values[:, 0] * factor
        else:
            used = [k - start for k in _rows_in_use(bench, name, rows, start)]
            unit, old = units[column], values[:, column]
            least = LEAST[unit] * (np.abs(old).max() if unit == "N" else 1.0)
            if unit == "N":
                least = max(least, 100.0)
            if np.abs(new - old)[used].max() < least:
                continue
        for row, cells in enumerate(rows[start:]):
            if other is not None:
                cells[other] = repr(float(values[row, column]))
            cells[column] = repr(float(new[row]))
        changed = text_of(rows, separator)
        return text, lambda content, texts, n=name, c=changed: texts.update({n: c})


ANGLES = [("sign", -1.0), ("radians", np.pi / 180), ("degrees", 180 / np.pi), ("exchanged", 1.0)]
LENGTHS = [("sign", -1.0), ("metres", 1e-3), ("thousand", 1e3), ("exchanged", 1.0), ("cm", 0.1)]
TIMES = [("time", 1e-3), ("time", 1e3)]
COLUMNS = {
    "deg": [*ANGLES, *TIMES],
    "rad": [*ANGLES, *TIMES],
    "mm": [*LENGTHS, *TIMES],
    "m": [*LENGTHS, *TIMES],
    "N": [("sign", -1.0), ("BW", 1 / 700), ("kN", 1e-3), ("thousand", 1e3), ("exchanged", 1.0)],
}


# Scene


def key_edit(bench, rng):
    """Return a random edit of a key of the scene."""
    while True:
        content = bench.content
        where = pick(rng, sorted(_keys(content)))
        old = content
        for part in where.split("."):
            old = old[int(part)] if isinstance(old, list) else old[part]
        new = _mistaken(where, old, rng)
        if new is not None:
            return f"{where} = {new!r}", lambda c, texts, w=where, v=new: set_key(c, w, v)


def _keys(content, above=""):
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        if key in ("notes", "columns", "options", "output"):
            continue
        if isinstance(value, dict) or (isinstance(value, list) and key == "ligament"):
            yield from _keys(value, f"{above}{key}.")
        elif isinstance(value, dict | list | str | int | float | bool):
            if isinstance(key, int) and isinstance(value, dict):
                yield from _keys(value, f"{above}{key}.")
            else:
                yield f"{above}{key}"


def _mistaken(where, old, rng):
    """Return a mistaken value of a key; None: no mistake is defined for this key."""
    key = where.split(".")[-1]
    if key in ("length_unit", "unit"):
        return pick(rng, sorted({"m", "cm", "mm"} - {old}))
    if key == "angle_unit":
        return "rad" if old == "deg" else "deg"
    if key in ("axes", "laboratory_axes"):
        return pick(rng, ("+x,+z,-y", "+z,+y,-x", "-x,+y,+z", "+y,+x,-z", "+x,-y,-z", "x,y,y"))
    if key == "side":
        return "left"
    if key == "mass_kg":
        return old * pick(rng, (2.2046, 10.0, 0.1, 9.81, 1000.0))
    if key == "height_mm":
        return old * pick(rng, (0.1, 1e-3, 0.0394))
    if key.startswith("stiffness"):
        return old * pick(rng, (1000.0, 1e-3, -1.0))
    if key == "slack_length_mm":
        return old * pick(rng, (10.0, 0.1, 1e-3, 2.0))
    if key in ("point_mm", "ankle_mm"):
        new = np.array(old) * pick(rng, (1e-3, 10.0, 0.1, -1.0))
        if rng.random() < 0.3:
            new = np.roll(old, 1)
        return new.tolist() if np.linalg.norm(new - old) > LEAST["mm"] else None
    if isinstance(old, str) and key not in ("name",):
        return _misspelt(old, rng)
    if isinstance(old, float | int) and key in (
        "mass_kg",
        "resolution_mm",
        "cutoff_Hz",
        "friction",
    ):
        return pick(rng, (True, str(old), -old))
    return None
