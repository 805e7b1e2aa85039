"""Options that several commands share, rules that refuse options without effect, and examples.

An option that would be ignored is refused, because the user expects an effect. `RULES` has the
rules by command; `tests/test_option_rules.py` checks that each option has an effect or a rule.
"""

import argparse
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tkamb.errors import InputError
from tkamb.io.toml_text import check_key, check_limits


def option(
    parser: Any, names: str, help: str, kind: Callable[[str], Any] | None = None, **more: Any
) -> None:
    """Add an option to a parser.

    Args:
        names: names of the option, and a word for its value: "--out DIR". Without this word,
            `choices` and `action`, the option is a switch.
        kind: function from the text of the value to the value; None: text.
    """
    words = names.split()
    flags = [word for word in words if word.startswith("-")]
    if len(words) > len(flags):
        more["metavar"] = words[-1]
    elif not more.keys() & {"choices", "action"}:
        more["action"] = "store_true"
    parser.add_argument(*flags, help=help, **more, **({} if kind is None else {"type": kind}))


def add_scene_options(command: Any) -> None:
    """Add scene, --contact, --resolution, --out, --frames and --set to a command."""
    command.add_argument("scene", type=Path, help="scene.toml")
    option(command, "--contact NAME", "contact model (`tkamb contact list`)")
    option(command, "--resolution MM", "spacing of the map points", float)
    option(command, "--out DIR", "output folder", Path)
    option(command, "--frames A:B:STEP", "frames, as a slice in Python", _frames)
    add_set(command)


def add_set(command: Any) -> None:
    """Add --set to a command."""
    option(
        command,
        "--set TABLE.KEY=VALUE",
        "override a key of the scene; a list in brackets and quotes: "
        "--set 'contact.released=[\"adduction\"]'",
        _setting,
        action="append",
        default=[],
    )


def add_preset(command: Any) -> None:
    """Add --as to a command."""
    option(
        command,
        "--as NAME",
        "apply a study's own choices to the scene: sharma-2008; --set still overrides them",
        dest="preset",
    )


def add_force(command: argparse.ArgumentParser) -> None:
    """Add --force beside an --out of one file."""
    option(command, "--force", "--out may replace a file that tkamb did not write")


def overrides_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return dotted scene key -> value."""
    overrides = dict(options.set)
    if options.contact:
        overrides["contact.model"] = options.contact
    if options.resolution is not None:
        overrides["contact.resolution_mm"] = options.resolution
    return overrides


def _frames(text: str) -> slice:
    from tkamb.run.simulation import frames_slice

    try:
        return frames_slice(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _setting(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise argparse.ArgumentTypeError(f"'{text}' is not TABLE.KEY=VALUE")
    if "\n" in text.strip():
        raise argparse.ArgumentTypeError("is more than one line; give --set for each key")
    try:
        check_key(key, f"'{key[:40]}'")
        check_limits(value, f"'{key.strip()}'")
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    try:
        return key.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


@dataclass(frozen=True)
class Rule:
    """The condition under which an option has an effect.

    Args:
        needs: options; at least one of them must be given. Empty: none is needed.
        excludes: options with which `option` has no effect.
        because: reason, printed after "does not go with --x" or "needs --x".
        unless: value of the excluded option with which `option` still has an effect.
    """

    option: str
    needs: tuple[str, ...] = ()
    excludes: tuple[str, ...] = ()
    because: str = ""
    unless: str | None = None


MESHES = ("--femoral", "--insert")
POSE_OPTIONS = (
    *("--pose-columns", "--pose-sequence", "--pose-units", "--pose-signs-turned"),
    *("--stride", "--stance"),
)
POSED = "the poses are the knee's motion"
MODELS_OWN = "the file holds the model's coordinates, not markers"
NO_OUTPUT = "nothing is written"
ONE_BY_ONE = "it varies one input at a time"
WORKERS_OF_CLUSTER = Rule(
    "--workers", excludes=("--dask",), because="a cluster has its own workers", unless="local"
)

RULES: dict[str, tuple[Rule, ...]] = {
    "import": (
        Rule("--grf-force", needs=("--grf",)),
        Rule("--static", excludes=("--motion",), because=MODELS_OWN),
        Rule("--static", excludes=("--poses",), because=POSED),
        *(
            Rule(option, excludes=("--motion",), because=MODELS_OWN)
            for option in ("--register", "--no-register", "--with")
        ),
        *(
            Rule(option, excludes=("--poses",), because=POSED)
            for option in ("--register", "--no-register", "--with")
        ),
        Rule("--with", excludes=("--no-register",), because="only a registration reads them"),
        Rule("--femoral-frame", needs=("--femoral",)),
        Rule("--insert-frame", needs=("--insert",)),
        Rule("--patella-frame", needs=("--patella",)),
        Rule("--patella", needs=MESHES),
        Rule("--femur-bone", needs=("--patella",), because="the quadriceps wraps it"),
        Rule("--mesh-unit", needs=MESHES),
        Rule("--mesh-axes", needs=MESHES),
        Rule("--contact", needs=MESHES, because="contact is between the two"),
        *(Rule(option, needs=("--poses",)) for option in POSE_OPTIONS),
        Rule("--poses", excludes=("--motion",), because=MODELS_OWN),
        Rule("--stride", excludes=("--cycle",), because="both state where 0 and 100 % lie"),
        Rule("--muscles", needs=("--patella",), because="the quadriceps pulls on it"),
        Rule("--stride", excludes=("--interval",), because="both choose the part to use"),
        Rule("--plates", needs=("--c3d",), because="other files hold no plates"),
        Rule(
            "--laboratory-axes", excludes=("--motion",), because="forces are in the model's ground"
        ),
        Rule("--without", excludes=("--motion",), because=MODELS_OWN),
        Rule("--method", excludes=("--motion",), because=MODELS_OWN),
        Rule("--method", excludes=("--poses",), because=POSED),
        Rule("--marker-prefix", excludes=("--motion",), because=MODELS_OWN),
        Rule("--length-unit", excludes=("--motion",), because=MODELS_OWN),
        *(
            Rule(option, needs=("--c3d",), because="tables are in N and N·m")
            for option in ("--force-unit", "--moment-unit")
        ),
        *(
            Rule(option, excludes=("--grf",), because="tables are in N and N·m")
            for option in ("--force-unit", "--moment-unit")
        ),
    ),
    "uncertainty": (
        *(
            Rule(o, excludes=("--screen",), because=NO_OUTPUT)
            for o in ("--out", "--resume", "--force")
        ),
        *(
            Rule(o, excludes=("--screen",), because=ONE_BY_ONE)
            for o in ("--samples", "--method", "--indices")
        ),
        WORKERS_OF_CLUSTER,
    ),
    "cohort": (WORKERS_OF_CLUSTER,),
    "wear": (
        Rule("--springs", needs=("--simulator",)),
        Rule("--period", needs=("--simulator",), because="a scene has its own times"),
    ),
    "view": (
        Rule(
            "--port",
            excludes=("--html", "--png", "--gif", "--mp4"),
            because="only a window has a port",
        ),
        Rule("--force", needs=("--html", "--png", "--gif", "--mp4"), because=NO_OUTPUT),
    ),
    "export": (
        Rule("--out", needs=("--vtp", "--figures", "--deck"), because="--sto names its own file"),
        Rule("--frame", needs=("--deck",)),
        Rule("--resolution", needs=("--deck",)),
        Rule("--force", excludes=("--sto",), because="--sto replaces no file"),
    ),
    "tradeoff": (
        Rule("SCENE", excludes=("--quick",), because="--quick measures two cases of its own"),
    ),
    "press": (
        Rule("--force", needs=("--out",), because=NO_OUTPUT),
        Rule("--restore-when", needs=("--adjust",)),
    ),
    "check": (Rule("--force", needs=("--out",), because=NO_OUTPUT),),
    "mesh lattice": (Rule("--force", needs=("--out",), because=NO_OUTPUT),),
}


def check_options(
    parser: argparse.ArgumentParser, arguments: Sequence[str], options: argparse.Namespace
) -> None:
    """Raise if an option has no effect beside the others."""
    command, leaf, remaining = command_of(parser, arguments)
    present = _option_names(leaf, remaining)
    for rule in RULES.get(command, ()):
        if rule.option not in present:
            continue
        reason = f": {rule.because}" if rule.because else ""
        if rule.needs and not present & {*rule.needs}:
            raise InputError(
                f"needs {' or '.join(rule.needs)}{reason}",
                rule.option,
                f"leave it out, or give {rule.needs[0]}",
            )
        for other in rule.excludes:
            value = getattr(options, other.lstrip("-").replace("-", "_"), None)
            if other in present and (rule.unless is None or value != rule.unless):
                raise InputError(f"does not go with {other}{reason}", rule.option, "leave one out")


def command_of(
    parser: argparse.ArgumentParser, arguments: Sequence[str]
) -> tuple[str, argparse.ArgumentParser, Sequence[str]]:
    """Return the command's name, its parser, and the arguments after it."""
    names, remaining = [], list(arguments)
    while verbs := _verbs(parser):
        index = next((k for k, word in enumerate(remaining) if word in verbs), None)
        if index is None:
            break
        names.append(remaining[index])
        parser, remaining = verbs[remaining[index]], remaining[index + 1 :]
    return " ".join(names), parser, remaining


def leaf_parsers(
    parser: argparse.ArgumentParser, name: str = ""
) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the name and the parser of every command."""
    verbs = _verbs(parser)
    if not verbs:
        yield name, parser
    for verb, inner in verbs.items():
        yield from leaf_parsers(inner, f"{name} {verb}".strip())


def _verbs(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _option_names(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> set[str]:
    """Return the long names of options, also of abbreviated ones, and of an optional positional
    argument its metavar.
    """
    names = {
        name: next(o for o in action.option_strings if o.startswith("--"))
        for action in parser._actions
        for name in action.option_strings
        if any(o.startswith("--") for o in action.option_strings)
    }
    present = set()
    for word in arguments:
        if word == "--":
            break
        option = word.partition("=")[0]
        full = [name for name in names if name.startswith(option)] if option[:2] == "--" else []
        match = option if option in names else full[0] if len(full) == 1 else None
        if match is not None:
            present.add(names[match])
    result, _ = parser.parse_known_args(list(arguments))
    for action in parser._actions:
        if action.nargs == "?" and not action.option_strings and getattr(result, action.dest):
            present.add(str(action.metavar))
    return present


EXAMPLES: dict[str, tuple[str, ...]] = {
    "new": (
        "tkamb new my_knee",
        "tkamb new p17 --side left --mass-kg 92 --height-mm 1830 --sex female",
    ),
    "methods": ("tkamb methods out/my_knee", "tkamb methods out/my_knee > methods.txt"),
    "settings": ("tkamb settings", "tkamb settings lattice --json"),
    "live": (
        "tkamb live my_knee/scene.toml",
        "tkamb live out/my_knee --frame 60 --contact lattice --out kept",
    ),
    "check": (
        "tkamb check my_knee/scene.toml",
        "tkamb check my_knee/scene.toml --set patient.mass_kg=82 --out check.html",
    ),
    "run": (
        "tkamb run my_knee/scene.toml",
        "tkamb run my_knee/scene.toml --contact foundation --resolution 2 --frames 0:100:5 "
        "--out out/quick",
        "tkamb run my_knee/scene.toml --pack my_knee.zip",
    ),
    "verify": ("tkamb verify out/my_knee", "tkamb verify my_knee.zip --rerun"),
    "report": ("tkamb report out/my_knee", "tkamb report out/quick"),
    "compare": (
        "tkamb compare out/thick out/thin",
        "tkamb compare out/a out/b out/c --axis flexion --out out/designs",
    ),
    "press": (
        "tkamb press femoral.stl insert.stl --load 2000",
        "tkamb press femoral.stl insert.stl --load 1500 --units m --axes=-x,+y,-z "
        "--contact lattice --json",
    ),
    "contact list": ("tkamb contact list", "tkamb contact list | grep lattice"),
    "mesh check": ("tkamb mesh check insert.stl", "tkamb mesh check femoral.stl insert.stl --json"),
    "mesh part": (
        "tkamb mesh part parts.stl 1 --out insert.stl",
        "tkamb mesh part parts.stl 2 --out femoral.ply",
    ),
    "mesh lattice": (
        "tkamb mesh lattice insert.stl --resolution 2",
        "tkamb mesh lattice insert.stl --units m --axes=-x,+y,-z --out lattice.vtu",
    ),
    "scene": ("tkamb scene --schema", "tkamb scene --schema > scene.schema.json"),
    "import": (
        "tkamb import model.osim --c3d walk.c3d --side right --mass-kg 67 --cycle --out patient",
        "tkamb import model.osim --motion ik.mot --grf grf.mot --side left --mass-kg 80 "
        "--femoral femoral.stl --insert insert.stl --mesh-unit m --mesh-axes=-x,+y,-z "
        "--out patient",
    ),
    "data get": ("tkamb data get dm", "tkamb data get dm --from downloads --to data/dm"),
    "export": (
        "tkamb export out/my_knee --sto my_knee.sto",
        "tkamb export out/my_knee --vtp --out out/maps",
        "tkamb export out/my_knee --figures --out figures",
    ),
    "view": (
        "tkamb view out/my_knee",
        "tkamb view my_knee/scene.toml --contact foundation --html my_knee.html",
    ),
    "tradeoff": ("tkamb tradeoff --quick", "tkamb tradeoff my_knee/scene.toml --out out/tradeoff"),
    "stability": ("tkamb stability --quick", "tkamb stability --workers 4 --out out/stability"),
    "wear": (
        "tkamb wear my_knee/scene.toml --cycles 5e6",
        "tkamb wear my_knee/scene.toml --simulator profile.csv --updates 20 --out out/wear",
    ),
    "uncertainty": (
        "tkamb uncertainty my_knee/scene.toml --screen",
        "tkamb uncertainty my_knee/scene.toml --samples 128 --workers 4 --out out/bands",
    ),
    "cohort": (
        "tkamb cohort cohort.toml --workers 4",
        "tkamb cohort cohort.toml --shard 1/8 --out out/cohort",
    ),
}


def add_examples(parser: argparse.ArgumentParser) -> None:
    """Write the examples at the end of each command's help."""
    for command, leaf in leaf_parsers(parser):
        examples = EXAMPLES.get(command)
        if examples:
            leaf.formatter_class = argparse.RawDescriptionHelpFormatter
            leaf.epilog = "\n  ".join(["examples:", *examples])
