"""OpenSim's list of external loads: which force of a table acts on which body."""

from dataclasses import dataclass, replace
from pathlib import Path

from tkamb.errors import InputError
from tkamb.io.importing.plates import TableForce, table_forces
from tkamb.io.importing.request import ImportRequest
from tkamb.io.opensim.document import Document, Element, open_document
from tkamb.io.recordings.tables import read_table


@dataclass(frozen=True)
class ExternalForce:
    """A force in a list of external loads.

    Args:
        beginnings: "force", "point" or "moment" -> beginning of the names of its columns.
    """

    name: str
    body: str
    beginnings: dict[str, str]


def with_external_loads(request: ImportRequest, foot: tuple[str, ...]) -> ImportRequest:
    """Return a request whose list of external loads is replaced by its table and the foot's forces.

    A request without such a list does not change. `foot` are the names of the foot's bodies.

    Raises:
        InputError: the list or its table cannot be read, or no force of it acts on the foot.
    """
    if request.grf is None or request.grf.suffix.lower() != ".xml":
        return request
    path, forces = _external_loads(request.grf)
    if request.grf_force is not None:
        return replace(request, grf=path)
    own = [force for force in forces if force.body in foot]
    if not own:
        bodies = ", ".join(force.body for force in forces) or "no body"
        what = f"applies no force to the foot ({', '.join(foot)}), but to {bodies}"
        raise InputError(what, request.grf, "give --grf-force")
    columns = table_forces(read_table(path))
    names = [_columns_of(force, columns, request.grf).name for force in own]
    return replace(request, grf=path, grf_force=",".join(names))


def _columns_of(force: ExternalForce, columns: list[TableForce], path: Path) -> TableForce:
    for candidate in columns:
        if all(
            name.startswith(force.beginnings[kind])
            for kind in ("force", "point", "moment")
            for role, name in candidate.columns.items()
            if role.startswith(kind) and force.beginnings[kind]
        ):
            return candidate
    names = ", ".join(candidate.name for candidate in columns) or "none"
    what = f"names columns '{force.beginnings['force']}…' of '{force.name}', but its table has "
    raise InputError(what + names, path, "correct its identifiers")


def _external_loads(path: Path) -> tuple[Path, list[ExternalForce]]:
    root, _ = open_document(path)
    document = Document(path, {})
    loads = root if root.tag == "ExternalLoads" else root.find("ExternalLoads")
    if loads is None:
        what = f"is no list of external loads: it has no <ExternalLoads> in <{root.tag}>"
        raise InputError(what, path, "give a .mot or .sto file")
    table = path.parent / document.text(loads, "datafile").replace("\\", "/")
    return table, [_force(document, entry) for entry in loads.findall("objects/ExternalForce")]


def _force(document: Document, entry: Element) -> ExternalForce:
    for tag in ("force_expressed_in_body", "point_expressed_in_body"):
        frame = document.text(entry, tag, default="ground").strip("/")
        if frame != "ground":
            what = f"has its numbers in the frame '{frame}', which is not read"
            raise InputError(what, document.where(entry), "express it in ground")
    tags = {"force": "force", "point": "point", "moment": "torque"}
    beginnings = {
        kind: document.text(entry, f"{tag}_identifier", default=" ").strip()
        for kind, tag in tags.items()
    }
    body = document.text(entry, "applied_to_body").split("/")[-1]
    return ExternalForce(entry.get("name", ""), body, beginnings)
