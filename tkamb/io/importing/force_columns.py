"""Forces of a table of ground reactions: the columns of force, point and moment of each.

Programs name these columns in many ways: `ground_force_1_vx`, `1_ground_force_px`,
`ground_torque_1_y`, `ground_moment_1_mx`, `ground_force_calcn_r_mx`, `f1_1`, `FP2_tz`. A name is
divided into its kind (force, point, moment), its axis, and the rest: the name of the force that
it belongs to. A column of moments that belongs to no force is an error if moments are needed; it
is never taken as zero.
"""

import re
from dataclasses import dataclass, field

from tkamb.errors import InputError
from tkamb.io.recordings.tables import Table

_KINDS = {"v": "force", "f": "force", "p": "point", "m": "moment", "t": "moment"}
_OF_MOMENT = re.compile(r"torque|moment|grm|free")
_OF_FORCE = re.compile(r"force|grf")
_OF_POINT = re.compile(r"cop|point|position")
_WORDS = re.compile(r"ground|reaction|force|torque|moment|free|grf|grm|cop|point|position|plate")
_NUMBERED = re.compile(r"(cop|[fpmt])_?(\d+)_?([xyz123])")
_NUMBERED_LAST = re.compile(r"(cop|[fpmt])_?([xyz])_?(\d+)")
_AXIS_LAST = re.compile(r"(?<!pelvis_t)[xyz]$")
_NAMED = re.compile(r"(.*?)([_. ]?)([vpfmt]?)([xyz])")


@dataclass(frozen=True)
class TableForce:
    """A force of a table.

    Args:
        name: common beginning of its column names.
        columns: role of a scene, like "force_1" or "moment_2" -> column.
    """

    name: str
    columns: dict[str, str] = field(default_factory=dict)

    def has(self, kind: str) -> bool:
        """Return whether all three columns of a kind are there."""
        return all(f"{kind}_{k}" in self.columns for k in (1, 2, 3))

    @property
    def moments(self) -> tuple[str, ...]:
        """The columns of the moment."""
        return tuple(v for k, v in self.columns.items() if k.startswith("moment"))


@dataclass(frozen=True)
class _Column:
    """A column's name, taken apart; `owner` is the plain name of its force."""

    name: str
    kind: str
    axis: int
    owner: str
    stem: str


def table_forces(table: Table) -> list[TableForce]:
    """Return the forces of a table, in its order.

    Raises:
        InputError: a column of moments that belongs to no force, or two for one axis.
    """
    columns = [c for name in table.columns if (c := _taken_apart(name)) is not None]
    result: dict[str, TableForce] = {}
    for column in columns:
        if column.kind == "force":
            result.setdefault(column.owner, TableForce(column.stem))
    forces = {k for k in result if sum(c.owner == k and c.kind == "force" for c in columns) >= 3}
    strangers = [c for c in columns if c.kind == "moment" and c.owner not in forces]
    alone = len(forces) == 1 and not any(c.kind == "moment" and c.owner in forces for c in columns)
    if strangers and alone and len({c.owner for c in strangers}) == 1:
        owner = next(iter(forces))
        columns = [
            _Column(c.name, c.kind, c.axis, owner, c.stem) if c in strangers else c for c in columns
        ]
        strangers = []
    for column in columns:
        if column.owner not in forces:
            continue
        role, own = f"{column.kind}_{column.axis}", result[column.owner].columns
        if role in own:
            raise InputError(
                f"has two columns for one axis of one {column.kind}: '{own[role]}' and "
                f"'{column.name}'",
                table.path,
                "rename or remove one",
            )
        own[role] = column.name
    _refuse_strangers(table, strangers, [result[k] for k in result if k in forces])
    return [result[k] for k in result if k in forces]


def _refuse_strangers(table: Table, strangers: list[_Column], forces: list[TableForce]) -> None:
    """Raise if columns of moments belong to no force, and some force has no moment."""
    read = {name for force in forces for name in force.columns.values()}
    others = [
        name
        for name in (*table.columns, *table.equal)
        if name not in read and (_OF_MOMENT.search(name.lower()) or _AXIS_LAST.search(name.lower()))
    ]
    others += [column.name for column in strangers if column.name not in others]
    lacking = [force.name for force in forces if not force.moments]
    if others and lacking:
        raise InputError(
            f"has a column of moments, '{others[0]}', that belongs to none of its forces "
            f"({', '.join(force.name for force in forces)})",
            table.path,
            f"name it after its force, like {lacking[0]}_mx, or remove it",
        )


def _taken_apart(name: str) -> _Column | None:
    """Return the parts of a column's name; None if it is not a force, point or moment."""
    plain = name.lower().rstrip()
    if match := _NUMBERED.fullmatch(plain):
        kind, owner, axis = match.groups()
        return _Column(name, _kind(kind), "xyz123".index(axis) % 3 + 1, owner, f"{name[0]}{owner}")
    if match := _NUMBERED_LAST.fullmatch(plain):
        kind, axis, owner = match.groups()
        return _Column(name, _kind(kind), "xyz".index(axis) + 1, owner, f"{name[0]}{owner}")
    match = _NAMED.fullmatch(plain)
    if match is None:
        return None
    stem, separator, letter, axis = match.groups()
    if letter and not separator and (stem + letter).endswith(("moment", "cop")):
        stem, letter = stem + letter, ""
    if letter in ("m", "t", "f") and not (_WORDS.search(stem) or re.search(r"\d|fp", stem)):
        return None  # pelvis_tx is a coordinate
    kind = _KINDS.get(letter) or _kind_of_words(stem)
    if kind is None:
        return None
    owner = re.sub(r"[^a-z0-9]", "", _WORDS.sub("", stem))
    own = name[: len(stem)].rstrip("_. ")
    return _Column(name, kind, "xyz".index(axis) + 1, owner, own)


def _kind(letter: str) -> str:
    return "point" if letter == "cop" else _KINDS[letter]


def _kind_of_words(stem: str) -> str | None:
    for pattern, kind in ((_OF_MOMENT, "moment"), (_OF_POINT, "point"), (_OF_FORCE, "force")):
        if pattern.search(stem):
            return kind
    return None
