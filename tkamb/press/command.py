"""`tkamb press`: arguments in, exit status out."""

import argparse
import json
from pathlib import Path
from typing import Any

from tkamb.command_options import add_no_cache, without_cache
from tkamb.defaults import CONTACT_MODEL


def add_press(commands: Any) -> None:
    """Add `press` to the command line."""
    press = commands.add_parser("press", help="contact alone: press two meshes together")
    press.add_argument("femoral", type=Path)
    press.add_argument("insert", type=Path)
    press.add_argument("--load", type=float, required=True, metavar="N")
    press.add_argument("--units", choices=("mm", "m"), default="mm", help="of both meshes")
    pose = press.add_mutually_exclusive_group()
    pose.add_argument(
        "--pose",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "RX", "RY", "RZ"),
        help="femoral mesh in the insert mesh's axes: mesh units, degrees (intrinsic x-y-z)",
    )
    pose.add_argument("--pose-file", type=Path, metavar="F", help="the same six numbers in a file")
    press.add_argument(
        "--contact", default=CONTACT_MODEL, metavar="NAME", help="default: %(default)s"
    )
    add_no_cache(press)
    press.add_argument("--resolution", type=float, default=1.0, metavar="MM")
    press.add_argument("--bearing", choices=("fixed", "mobile"), default="fixed")
    press.add_argument("--material", default="polyethylene", metavar="NAME")
    press.add_argument(
        "--axes",
        default="+x,+y,+z",
        metavar="ANT,SUP,RIGHT",
        help="mesh axes that point anterior, superior, right; write --axes=-x,+y,-z",
    )
    press.add_argument("--side", choices=("right", "left"), default="right")
    press.add_argument("--adjust", action=argparse.BooleanOptionalAction, default=False)
    press.add_argument("--json", action="store_true")
    press.set_defaults(command=_press)


def _press(options: argparse.Namespace) -> int:
    from tkamb.press.press import press_meshes, read_pose

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
        options=without_cache(options.contact) if options.no_cache else None,
    )
    print(json.dumps(report.as_dict(), indent=2) if options.json else "\n".join(report.lines()))
    return 0 if report.carried else 1
