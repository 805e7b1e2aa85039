"""`tkamb mesh`: its arguments, and what it prints."""

import argparse
import json
from pathlib import Path
from typing import Any


def add_mesh(commands: Any) -> None:
    """Add the command `mesh` and its verbs to the parser's commands."""
    mesh = commands.add_parser("mesh", help="look at a mesh before it is used")
    verbs = mesh.add_subparsers(required=True, metavar="VERB")
    check = verbs.add_parser("check", help="health, and unit and axes as questions")
    check.add_argument("files", type=Path, nargs="+", metavar="FILE")
    check.add_argument("--json", action="store_true")
    check.set_defaults(command=_mesh_check)
    part = verbs.add_parser("part", help="one of several bodies into a file of its own")
    part.add_argument("file", type=Path, metavar="FILE")
    part.add_argument("number", type=int, metavar="N", help="as `tkamb mesh check` numbers them")
    part.add_argument("--out", type=Path, required=True, metavar="F", help=".stl, .ply or .obj")
    part.set_defaults(command=_mesh_part)
    lattice = verbs.add_parser("lattice", help="the lattice of an insert, and how good it is")
    lattice.add_argument("insert", type=Path, metavar="INSERT")
    lattice.add_argument("--resolution", type=float, default=1.0, metavar="MM", help="cell size")
    lattice.add_argument("--units", choices=("mm", "m"), default="mm", help="of the mesh")
    lattice.add_argument(
        "--axes",
        default="+x,+y,+z",
        metavar="ANT,SUP,RIGHT",
        help="mesh axes that point anterior, superior, right; write --axes=-x,+y,-z",
    )
    lattice.add_argument("--side", choices=("right", "left"), default="right")
    lattice.add_argument("--out", type=Path, metavar="F.vtu", help="for ParaView or meshio")
    lattice.add_argument("--json", action="store_true")
    lattice.set_defaults(command=_mesh_lattice)


def _mesh_check(options: argparse.Namespace) -> int:
    from tkamb.inputs.mesh_check import check_mesh

    found = [check_mesh(path) for path in options.files]
    if options.json:
        print(json.dumps([health.as_dict() for health in found], indent=2))
    else:
        print("\n".join(line for health in found for line in health.lines()))
    return 0


def _mesh_part(options: argparse.Namespace) -> int:
    from tkamb.mesh_part import write_body

    line = write_body(options.file, options.number, options.out)
    print(f"{options.out}: {line}")
    return 0


def _mesh_lattice(options: argparse.Namespace) -> int:
    from tkamb.lattice_file import lattice_of_file

    report = lattice_of_file(
        options.insert,
        options.resolution,
        units=options.units,
        axes=options.axes,
        side=options.side,
        out=options.out,
    )
    print(json.dumps(report.as_dict(), indent=2) if options.json else "\n".join(report.lines()))
    return 0
