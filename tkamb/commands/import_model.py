"""`tkamb import` and `tkamb data`: their arguments and printed lines."""

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from tkamb.commands.options import option
from tkamb.errors import InputError
from tkamb.io.activities import Activity
from tkamb.io.datasets import NAMES, read_dataset
from tkamb.units import ANGLE, LENGTH

if TYPE_CHECKING:
    from tkamb.io.importing.patient import ImportedPatient
    from tkamb.io.importing.scene_text import ImportRequest


def add_data(commands: Any) -> None:
    """Add the command `data` to the parser's commands."""
    data = commands.add_parser("data", help="real data for the shipped scenes")
    verbs = data.add_subparsers(required=True, metavar="VERB")
    get = verbs.add_parser("get", help="download a data set, or take it from a folder")
    get.add_argument("name", choices=NAMES, help="dm: Grand Challenge subject DM")
    source = get.add_mutually_exclusive_group()
    option(source, "--from DIR", "folder of files downloaded by hand", Path, dest="source")
    option(source, "--url URL", "address of a mirror with the same paths")
    option(
        get,
        "--to DIR",
        "folder for the data; default: ../shared/data/dm, which the scenes of models/dm use",
        Path,
    )
    get.set_defaults(command=_get)


def _get(options: argparse.Namespace) -> int:
    from tkamb.io.datasets import download, take_from

    dataset = read_dataset(options.name)
    folder = options.to or dataset.folder
    if options.source is not None:
        files = take_from(dataset, folder, options.source)
        reason = f"not in {options.source}"
    else:
        files = download(dataset, folder, options.url)
        reason = "their address is not known; no scene needs them; --from DIR copies them"
    print(f"{folder}: {dataset.says} ({dataset.licence}, {dataset.repository})")
    counts = f"{len(files.written)} files written, {len(files.kept)} were there"
    print(f"  {counts}; the SHA-256 of each is as expected")
    if files.absent:
        print(f"  missing ({reason}): {', '.join(files.absent)}")
    return 0


def add_import(commands: Any) -> None:
    """Add the command `import` to the parser's commands."""
    command = commands.add_parser("import", help="a patient from an OpenSim model and a recording")
    command.add_argument("model", type=Path, metavar="MODEL.osim", help="an OpenSim model")
    source = command.add_mutually_exclusive_group(required=True)
    option(source, "--c3d F", "recording of markers and force plates", Path)
    option(source, "--trc F", "recording of markers", Path)
    option(source, "--motion F", "motion file of the model's coordinates", Path)
    option(
        command,
        "--grf F",
        ".mot or .sto of the ground reactions, or OpenSim's list of external loads (.xml)",
        Path,
    )
    option(
        command,
        "--grf-force NAME,NAME",
        "first part of the names of the foot's columns in --grf, like ground_force_2; several "
        "are summed",
    )
    option(
        command,
        "--static F",
        "standing trial, which gives the marker positions on the segments",
        Path,
    )
    registers = command.add_mutually_exclusive_group()
    option(
        registers,
        "--register",
        "find the marker positions on the segments together with the motion; default: where "
        "the markers misfit the model by over 10 mm, or the knee centres by over 20 mm",
        dest="register",
        default=None,
    )
    option(
        registers,
        "--no-register",
        "use the model's marker positions, or those of --static, in any case",
        dest="register",
        action="store_false",
        default=None,
    )
    option(
        command,
        "--with TRIAL",
        "recordings of the same markers on the same day, which the registration uses as well",
        Path,
        dest="companions",
        nargs="+",
        action="extend",
        default=[],
    )
    option(command, "--side", "side of the knee", choices=("right", "left"), required=True)
    option(command, "--mass-kg KG", "mass of the subject", float, required=True)
    for part in ("femoral", "insert", "patella"):
        option(command, f"--{part} F", f"mesh of the {part} component", Path)
        option(
            command, f"--{part}-frame NAME", "body or frame of the model that this mesh belongs to"
        )
    option(command, "--femur-bone F", "mesh of the femur that the quadriceps may wrap", Path)
    option(
        command,
        "--mesh-unit --units",
        "unit of all meshes; it is never guessed",
        dest="mesh_unit",
        choices=tuple(LENGTH),
    )
    option(
        command,
        "--mesh-axes --axes ANT,SUP,RIGHT",
        "axes of the meshes that point anterior, superior and to the right; write "
        "--mesh-axes=-x,+y,-z",
        dest="mesh_axes",
    )
    _add_poses(command)
    _add_inferred(command)
    option(command, "--out DIR", "folder of scene and patient.urdf", Path, required=True)
    option(command, "--scene NAME", "name of the scene file", default="scene.toml")
    option(
        command,
        "--contact",
        "the scene's contact model; default: %(default)s",
        choices=("foundation", "lattice"),
        default="foundation",
    )
    option(
        command,
        "--activity",
        "activity whose published values the report shows",
        choices=get_args(Activity),
    )
    option(
        command,
        "--muscles",
        "all muscles of the model share the load ([muscles]); default: the quadriceps alone",
    )
    option(
        command,
        "--cycle A:B",
        "plot against per cent of the gait cycle: 0 and 100 %% at these times (s); without "
        "A:B, or with the word plates: two foot strikes on the force plates",
        _cycle,
        nargs="?",
        const="plates",
    )
    option(command, "--note TEXT", "sentence for the report", action="append", default=[])
    scale = command.add_mutually_exclusive_group()
    option(
        scale,
        "--scale-mass",
        "scale the model's masses to the subject's; default: where they differ by over 1 %%",
        dest="scale",
        default=None,
    )
    option(
        scale,
        "--keep-mass",
        "use the model's masses unchanged",
        dest="scale",
        action="store_false",
        default=None,
    )
    command.set_defaults(command=_import)


def _add_inferred(command: argparse.ArgumentParser) -> None:
    option(command, "--knee JOINT", "name of the model's femorotibial joint")
    option(
        command,
        "--plates 2,3",
        "numbers of the force plates under this foot, or the word none",
        _numbers,
    )
    option(command, "--interval A:B", "part of the recording to use, s", _interval)
    option(
        command,
        "--laboratory-axes FORWARD,UP,RIGHT",
        "axes of the recording that point forward, up, right",
    )
    option(command, "--without A,B", "markers to leave out", _names, default=())
    option(command, "--marker-prefix NAME", "prefix of the marker labels to use: JW of JW:RHeel")
    option(
        command,
        "--length-unit",
        "length unit of a .c3d that states none",
        choices=("m", "cm", "mm"),
    )
    option(command, "--force-unit N", "force unit of a .c3d that states none")
    option(command, "--moment-unit Nmm", "moment unit of a .c3d that states none")
    option(
        command,
        "--method",
        "fit the markers of thigh and shank separately, or the whole leg as a chain; default: "
        "segments",
        choices=("segments", "chain"),
        default="segments",
    )
    option(
        command,
        "--cutoff-hz HZ",
        "cut-off of the low-pass filter of markers and forces; default: 6",
        float,
        default=6.0,
    )


def _add_poses(command: argparse.ArgumentParser) -> None:
    option(
        command,
        "--poses F",
        "recorded poses of the femoral mesh in the axes of the insert mesh",
        Path,
    )
    option(
        command,
        "--pose-columns R1,R2,R3,X,Y,Z",
        "columns of --poses: three angles, then three positions",
        _names,
    )
    option(
        command,
        "--pose-sequence XYZ",
        "sequence of the angles in --poses; upper case: intrinsic (Rx Ry Rz)",
    )
    option(command, "--pose-units rad,m", "units of the angles and positions in --poses", _names)
    option(
        command,
        "--pose-signs-turned ROLES",
        "angles and positions to reverse in sign: rotation_1, …",
        _names,
        default=(),
    )
    option(
        command,
        "--stride A:B",
        "times of the recording, s, at 0 and 100 %% of the poses",
        _interval,
    )
    option(
        command,
        "--stance A:B",
        "part of the poses with a loaded foot, in the unit of their time column; the mean "
        "position of the knee centre in the shank is computed from it",
        _interval,
    )


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _numbers(text: str) -> tuple[int, ...]:
    if text == "none":
        return ()
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not numbers like 2,3, or none") from None


def _interval(text: str) -> tuple[float, float]:
    try:
        start, end = (float(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not two numbers A:B") from None
    return start, end


def _cycle(text: str) -> "tuple[float, float] | Literal['plates']":
    if text == "plates":
        return "plates"
    start, end = _interval(text)
    if start >= end:
        raise argparse.ArgumentTypeError(f"the times in '{text}' do not increase")
    return start, end


def _import(options: argparse.Namespace) -> int:
    from tkamb.io.importing.patient import import_patient, write_patient

    patient = import_patient(import_request(options), options.out)
    markers = write_patient(patient, options.out, options.scene)
    scene = options.out / options.scene
    if patient.registration is not None:
        picture = scene.with_suffix(".registration.png")
        _write_registration(patient, picture)
        markers = (*markers, f"picture of the registration: {picture}")
    print("\n".join([*patient.report, *markers, f"scene: {scene}", f"next: tkamb check {scene}"]))
    return 0


def _write_registration(patient: "ImportedPatient", path: Path) -> None:
    from tkamb.files import replaced_file
    from tkamb.show.leg_picture import draw_registration

    assert patient.registration is not None
    figure = draw_registration(patient.scene.links, patient.model_segments, patient.registration)
    with replaced_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def import_request(options: argparse.Namespace) -> "ImportRequest":
    """Return the request of a command line."""
    from tkamb.io.importing.scene_text import ImportRequest
    from tkamb.io.recordings.laboratory import GivenUnits

    if not options.mass_kg > 0:
        raise InputError(f"a mass of {options.mass_kg:g} kg is not positive", "--mass-kg")
    if not options.cutoff_hz > 0:
        raise InputError(f"a frequency of {options.cutoff_hz:g} Hz is not positive", "--cutoff-hz")
    for name in ("force_unit", "moment_unit"):
        if getattr(options, name) and not (options.c3d and options.grf is None):
            option = f"--{name.replace('_', '-')}"
            raise InputError("is for the plates of a .c3d: tables are in N and N·m", option)
    if options.length_unit and options.motion:
        raise InputError("is for recordings of markers", "--length-unit", "leave it out")
    if options.grf_force and not options.grf:
        raise InputError("needs --grf", "--grf-force")
    if Path(options.scene).name != options.scene or not options.scene.endswith(".toml"):
        hint = "--out names the folder"
        raise InputError(f"'{options.scene}' is not a name of a .toml file", "--scene", hint)
    return ImportRequest(
        options.model,
        options.side,
        options.mass_kg,
        options.c3d or options.trc or options.motion,
        grf=options.grf,
        grf_force=options.grf_force,
        poses=_poses(options),
        without=options.without,
        static=options.static,
        register=options.register,
        companions=tuple(options.companions),
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
        contact=options.contact,
        activity=options.activity,
        notes=tuple(options.note),
        prefix=options.marker_prefix,
        muscles=options.muscles,
        cycle=options.cycle,
        units=GivenUnits(options.length_unit, options.force_unit, options.moment_unit),
    )


def _meshes(options: argparse.Namespace) -> Any:
    from tkamb.io.importing.scene_text import Meshes

    meshes = (options.femoral, options.insert)
    if not any(meshes):
        return None
    if not all(meshes):
        raise InputError("go together", "--femoral and --insert", "give both or none")
    if options.mesh_unit is None or options.mesh_axes is None:
        missing = "--mesh-unit" if options.mesh_unit is None else "--mesh-axes"
        raise InputError("is not given, and is not guessed", missing, "`tkamb mesh check` helps")
    return Meshes(
        *meshes, options.patella, options.mesh_unit, options.mesh_axes, options.femur_bone
    )


def _poses(options: argparse.Namespace) -> Any:
    from tkamb.io.importing.recorded_poses import ROLES, PoseRecording

    if options.poses is None:
        return None
    columns = options.pose_columns or ROLES
    if len(columns) != len(ROLES):
        raise InputError(
            f"has {len(columns)} names", "--pose-columns", "three angles, then x, y, z"
        )
    if not re.fullmatch("[xyz]{3}|[XYZ]{3}", options.pose_sequence or ""):
        raise InputError("is not three axes, and is not guessed", "--pose-sequence", "as in XYZ")
    angle, _, length = ",".join(options.pose_units or ()).partition(",")
    if angle not in ANGLE or length not in LENGTH:
        raise InputError("are not two units, and are not guessed", "--pose-units", "as in rad,m")
    return PoseRecording(
        options.poses,
        tuple(columns),
        options.pose_sequence,
        angle,
        length,
        options.pose_signs_turned,
        options.stride,
        options.stance,
    )
