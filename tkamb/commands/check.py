"""`tkamb check`: its arguments, printed findings, and picture or page."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tkamb.commands.options import add_force, add_set, option
from tkamb.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tkamb.show.scene_check import SceneCheck

PICTURES = (".png", ".html")
POLICY = (
    "default-src 'none'; style-src-elem {style}; style-src-attr 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'"
)
"""Content security policy of the page: the browser loads nothing from elsewhere."""


def add_check(commands: Any) -> None:
    """Add `check` to the command line."""
    check = commands.add_parser("check", help="read and check a scene's files, without a run")
    check.add_argument("scene", type=Path, help="scene.toml")
    option(check, "--out F", "picture of the leg: .png, or .html with all findings", Path)
    add_set(check)
    add_force(check)
    option(check, "--json", "print the findings as JSON")
    check.set_defaults(command=_check)


def _check(options: argparse.Namespace) -> int:
    from tkamb.io.claim import check_output_file
    from tkamb.run.timing import Stages
    from tkamb.show.scene_check import check_scene

    if options.out and options.out.suffix.lower() not in PICTURES:
        hint = f"name it like check{PICTURES[0]}"
        raise InputError(f"does not end in {' or '.join(PICTURES)}", options.out, hint)
    check_output_file(options.out, options.force)
    with Stages(4 if options.out else 3) as stages:
        result = check_scene(options.scene, dict(options.set), stages.begin)
        if options.out:
            stages.begin("drawing the leg")
            _write_picture(result, options.out)
    written = [f"picture: {options.out}"] if options.out else []
    lines = [*result.lines(), *written, f"next: tkamb run {options.scene}"]
    print(json.dumps(result.as_dict(), indent=2) if options.json else "\n".join(lines))
    return 0


def _write_picture(check: "SceneCheck", path: Path) -> None:
    from tkamb.files import replaced_file, write_text
    from tkamb.show.leg_picture import draw_leg

    figure = draw_leg(check.case, check.recording)
    if path.suffix.lower() == ".html":
        write_text(path, check_html(check, figure))
        return
    with replaced_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def check_html(check: "SceneCheck", figure: "Figure") -> str:
    """Return the HTML page: questions, then the picture, then the content of each file."""
    from tkamb.show.pages import asset, policy_sources, render
    from tkamb.show.style import svg_text

    style = asset("tkamb.show", "report.css")
    return render(
        "tkamb.show",
        "check.html",
        policy=POLICY.format(style=policy_sources(style)),
        style=style,
        title=f"Check of {check.scene.resolve().parent.name}/{check.scene.name}",
        found=check,
        picture=svg_text(figure, "leg"),
    )
