"""One of several bodies of a mesh file, written into a file of its own."""

from pathlib import Path

import trimesh

from tkamb.atomic import replaced_file
from tkamb.errors import InputError
from tkamb.geometry.topology import separate_bodies
from tkamb.inputs.mesh_check import mended_mesh

FORMATS = (".stl", ".ply", ".obj")


def write_body(path: str | Path, number: int, out: str | Path) -> str:
    """Write a separate body of a mesh, mended as loading would, in the file's units and axes.

    Args:
        path: the mesh.
        number: of the body, as `tkamb mesh check` counts: 1 is the one with the largest skin.
        out: a new file, .stl, .ply or .obj.

    Returns:
        What was written, in a line.

    Raises:
        InputError: the mesh cannot be read, it has no such body, or `out` is there already, of
            another format, or cannot be written.
    """
    out = Path(out)
    if out.suffix.lower() not in FORMATS:
        raise InputError(f"is none of {', '.join(FORMATS)}", out, "name a file that ends so")
    if out.exists():
        raise InputError("is there already", out, "give a new file: nothing of yours is replaced")
    mended, scale = mended_mesh(path)
    bodies = separate_bodies(mended.vertices, mended.faces)
    if not 1 <= number <= len(bodies):
        raise InputError(
            f"has no body {number}", path, f"it has {len(bodies)}; `tkamb mesh check` lists them"
        )
    faces = mended.faces[bodies[number - 1].faces]
    body = trimesh.Trimesh(mended.vertices / scale, faces, process=False)
    body.remove_unreferenced_vertices()
    with replaced_file(out) as temporary:
        body.export(temporary, file_type=out.suffix.lower()[1:])
    return f"body {number} of {len(bodies)}, {len(faces)} triangles"
