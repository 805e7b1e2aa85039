"""`tkamb press`, `tkamb mesh` and `tkamb contact`: commands on meshes, without a scene."""

import argparse
import json
from pathlib import Path
from typing import Any

from tkamb.commands.options import add_force, option
from tkamb.errors import InputError
from tkamb.io import CONTACT_MODEL
from tkamb.run.guard import say
from tkamb.units import LENGTH

UNIT_OPTIONS = ("--units", "--mesh-unit")
AXES_OPTIONS = ("--axes", "--mesh-axes")
"""Every command on meshes accepts both spellings of an option."""


def add_press(commands: Any) -> None:
    """Add `press` to the command line."""
    press = commands.add_parser("press", help="press two meshes together, without a scene")
    press.add_argument("femoral", type=Path, help="mesh of the femoral component")
    press.add_argument("insert", type=Path, help="mesh of the insert")
    option(
        press, "--load N", "load (N) along the normal of the insert's bottom", float, required=True
    )
    _add_units(press, "unit of both meshes")
    pose = press.add_mutually_exclusive_group()
    pose.add_argument(
        "--pose",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "RX", "RY", "RZ"),
        help="pose of the femoral mesh in the insert mesh's axes: mesh units, degrees (intrinsic "
        "x-y-z)",
    )
    option(pose, "--pose-file F", "file with these six numbers", Path)
    option(
        press,
        "--contact NAME",
        "contact model (`tkamb contact list`); default: %(default)s",
        default=CONTACT_MODEL,
    )
    add_no_cache(press)
    option(
        press,
        "--resolution MM",
        "spacing of the map points and cell size of the lattice; default: 1",
        float,
        default=1.0,
    )
    option(
        press,
        "--bearing",
        "fixation of the insert; default: fixed",
        choices=("fixed", "mobile"),
        default="fixed",
    )
    option(
        press,
        "--material NAME|F.toml",
        "name of a material, or a file with the keys of a scene's [material]; default: %(default)s",
        default="polyethylene",
    )
    _add_side(press)
    option(
        press,
        "--adjust",
        "before the press, move the femoral mesh until both condyles touch; default: no",
        action=argparse.BooleanOptionalAction,
        default=False,
    )
    option(
        press,
        "--restore-when",
        "with --adjust: the press is compared with the adjustment, in penetration and in "
        "angle; the rotation of --pose is restored if both are larger than the adjustment's "
        "(both), or at least one of them (either); default: both",
        choices=("both", "either"),
    )
    option(press, "--out F.vtp", "file for the pressure map, for ParaView", Path)
    add_force(press)
    option(press, "--json", "print the result as JSON")
    press.set_defaults(command=_press)


def _press(options: argparse.Namespace) -> int:
    from tkamb.io.claim import check_output_file
    from tkamb.run.press import press_meshes, read_pose

    if options.out and options.out.suffix.lower() != ".vtp":
        raise InputError("is not a .vtp file", options.out, "give a name like map.vtp")
    check_output_file(options.out, options.force)
    pose = read_pose(options.pose_file) if options.pose_file else options.pose
    report = press_meshes(
        options.femoral,
        options.insert,
        options.load,
        units=options.units,
        pose=None if pose is None else tuple(pose),
        contact=options.contact,
        resolution_mm=options.resolution,
        bearing=options.bearing,
        material=options.material,
        axes=options.axes,
        side=options.side,
        adjust=options.adjust,
        restore_when=options.restore_when,
        options=without_cache(options.contact) if options.no_cache else None,
    )
    if options.out:
        report.write_map(options.out)
    print(json.dumps(report.as_dict(), indent=2) if options.json else "\n".join(report.lines()))
    if not report.carried:
        say(f"the load is not carried: {report.as_dict()['status']}")
        return 1
    return 0


def add_mesh(commands: Any) -> None:
    """Add the command `mesh` and its verbs to the parser's commands."""
    mesh = commands.add_parser("mesh", help="check a mesh before it is used")
    verbs = mesh.add_subparsers(required=True, metavar="VERB")
    check = verbs.add_parser("check", help="report holes, unit and axes of meshes")
    check.add_argument("files", type=Path, nargs="+", metavar="FILE", help="meshes")
    option(check, "--json", "print the findings as JSON")
    check.set_defaults(command=_mesh_check)
    part = verbs.add_parser("part", help="write one of several bodies to a separate file")
    part.add_argument("file", type=Path, metavar="FILE", help="mesh of several bodies")
    part.add_argument(
        "number", type=int, metavar="N", help="number of the body in `tkamb mesh check`"
    )
    option(part, "--out F", ".stl, .ply or .obj", Path, required=True)
    part.set_defaults(command=_mesh_part)
    lattice = verbs.add_parser(
        "lattice", help="make the lattice of an insert and report its quality"
    )
    lattice.add_argument("insert", type=Path, metavar="INSERT", help="mesh of the insert")
    option(lattice, "--resolution MM", "cell size", float, default=1.0)
    _add_units(lattice, "unit of the mesh")
    _add_side(lattice)
    option(lattice, "--out F.vtu", "file for the lattice, for ParaView or meshio", Path)
    add_force(lattice)
    option(lattice, "--json", "print the report as JSON")
    lattice.set_defaults(command=_mesh_lattice)


def _mesh_check(options: argparse.Namespace) -> int:
    from tkamb.io.recordings.mesh_check import check_mesh

    result = [check_mesh(path) for path in options.files]
    if options.json:
        print(json.dumps([health.as_dict() for health in result], indent=2))
    else:
        print("\n".join(line for health in result for line in health.lines()))
    return 0


def _mesh_part(options: argparse.Namespace) -> int:
    from tkamb.io.mesh_files import write_body

    line = write_body(options.file, options.number, options.out)
    print(f"{options.out}: {line}")
    return 0


def _mesh_lattice(options: argparse.Namespace) -> int:
    from tkamb.io.claim import check_output_file
    from tkamb.io.mesh_files import lattice_of_file

    check_output_file(options.out, options.force)
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


def add_contact(commands: Any) -> None:
    """Add the command `contact` and its verb."""
    contact = commands.add_parser("contact", help="contact models")
    verbs = contact.add_subparsers(required=True, metavar="VERB")
    verbs.add_parser("list", help="list names, assumptions and needs").set_defaults(
        command=_contact_list
    )


def _contact_list(options: argparse.Namespace) -> int:
    from tkamb.contact.registry import contact_descriptions

    for name, line in contact_descriptions().items():
        print(f"{name:18s} {line}")
    print(
        "times are for one press; a frame takes one press, with released coordinates 20 to 80 "
        "presses"
    )
    return 0


def _add_units(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument(
        *UNIT_OPTIONS,
        dest="units",
        choices=tuple(LENGTH),
        default="mm",
        help=f"{what}; default: mm",
    )


def _add_side(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        *AXES_OPTIONS,
        dest="axes",
        default="+x,+y,+z",
        metavar="ANT,SUP,RIGHT",
        help="mesh axes that point anterior, superior, right; write --axes=-x,+y,-z",
    )
    option(
        command,
        "--side",
        "side of the knee; default: right",
        choices=("right", "left"),
        default="right",
    )


def add_no_cache(command: argparse.ArgumentParser) -> None:
    """Add --no-cache to a command."""
    option(command, "--no-cache", "do not use the cache of prepared operators on disk")


def without_cache(contact: str | None) -> dict[str, Any]:
    """Return the option that turns off a contact model's cache on disk."""
    from tkamb.contact.registry import contact_options

    if contact is None:
        raise InputError("no contact is modelled", "--no-cache", "leave it out")
    if "cache" not in contact_options(contact):
        raise InputError(f"'{contact}' has no cache on disk", "--no-cache", "leave it out")
    return {"cache": False}
