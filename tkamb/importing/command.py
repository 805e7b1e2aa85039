"""`tkamb import`: its arguments, and what it prints."""

import argparse
from pathlib import Path
from typing import Any

from tkamb.errors import InputError


def add_import(commands: Any) -> None:
    """Add the command's parser."""
    p = commands.add_parser("import", help="a patient from an OpenSim model and a recording")
    p.add_argument("model", type=Path, metavar="MODEL.osim")
    source = p.add_mutually_exclusive_group(required=True)
    source.add_argument("--c3d", type=Path, metavar="F", help="markers and force plates")
    source.add_argument("--trc", type=Path, metavar="F", help="markers alone")
    source.add_argument("--motion", type=Path, metavar="F", help="the model's coordinates")
    p.add_argument("--grf", type=Path, metavar="F", help=".mot or .sto of the ground reactions")
    p.add_argument("--static", type=Path, metavar="F", help="standing trial: where markers sit")
    p.add_argument("--side", choices=("right", "left"), required=True)
    p.add_argument("--mass-kg", type=float, required=True, metavar="KG", help="of the subject")
    for part in ("femoral", "insert", "patella"):
        p.add_argument(f"--{part}", type=Path, metavar="F", help="mesh")
        p.add_argument(f"--{part}-frame", metavar="NAME", help="body or frame of its mesh")
    p.add_argument("--mesh-unit", choices=("m", "cm", "mm"))
    p.add_argument(
        "--mesh-axes",
        metavar="ANT,SUP,RIGHT",
        help="mesh axes that point anterior, superior, right; write --mesh-axes=-x,+y,-z",
    )
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    p.add_argument("--scene", default="scene.toml", metavar="NAME", help="name of the scene file")
    p.add_argument("--knee", metavar="JOINT", help="the femorotibial joint of the model")
    p.add_argument("--plates", type=_numbers, metavar="2,3", help="under the foot")
    p.add_argument("--interval", type=_interval, metavar="A:B", help="s, part of the recording")
    p.add_argument("--laboratory-axes", metavar="FORWARD,UP,RIGHT", help="of the recording")
    p.add_argument("--method", choices=("segments", "chain"), default="segments")
    p.add_argument("--cutoff-hz", type=float, default=6.0, metavar="HZ")
    scale = p.add_mutually_exclusive_group()
    scale.add_argument("--scale-mass", dest="scale", action="store_true", default=None)
    scale.add_argument("--keep-mass", dest="scale", action="store_false", default=None)
    p.set_defaults(command=_import)


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not numbers like 2,3") from None


def _interval(text: str) -> tuple[float, float]:
    try:
        start, end = (float(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not A:B in seconds") from None
    return start, end


def _import(options: argparse.Namespace) -> int:
    from tkamb.importing.patient import import_patient, write_patient
    from tkamb.importing.request import ImportRequest

    if not options.mass_kg > 0:
        raise InputError(f"{options.mass_kg:g} kg is no mass", "--mass-kg")
    if not options.cutoff_hz > 0:
        raise InputError(f"{options.cutoff_hz:g} Hz is no frequency", "--cutoff-hz")
    request = ImportRequest(
        options.model,
        options.side,
        options.mass_kg,
        options.c3d or options.trc or options.motion,
        grf=options.grf,
        static=options.static,
        meshes=_meshes(options),
        knee=options.knee,
        frames={
            "femoral component": options.femoral_frame,
            "insert": options.insert_frame,
            "patellar button": options.patella_frame,
        },
        plates=options.plates,
        interval=options.interval,
        laboratory_axes=options.laboratory_axes,
        scale_mass=options.scale,
        method=options.method,
        cutoff_Hz=options.cutoff_hz,
    )
    patient = import_patient(request, options.out)
    markers = write_patient(patient, options.out, options.scene)
    print("\n".join([*patient.report, *markers, f"scene: {options.out / options.scene}"]))
    return 0


def _meshes(options: argparse.Namespace) -> Any:
    from tkamb.importing.scene_text import Meshes

    given = (options.femoral, options.insert)
    if not any(given):
        if options.patella:
            raise InputError("needs --femoral and --insert", "--patella")
        return None
    if not all(given):
        raise InputError("go together", "--femoral and --insert", "give both or none")
    if options.mesh_unit is None or options.mesh_axes is None:
        missing = "--mesh-unit" if options.mesh_unit is None else "--mesh-axes"
        raise InputError("is not given, and is not guessed", missing, "`tkamb mesh check` helps")
    return Meshes(*given, options.patella, options.mesh_unit, options.mesh_axes)
