"""Options that all commands on a scene share: contact model, frames, keys to override."""

import argparse
import tomllib
from pathlib import Path
from typing import Any

from tkamb.errors import InputError
from tkamb.io.toml_text import check_key, check_limits


def add_scene_options(command: Any) -> None:
    """Add scene, --contact, --resolution, --out, --frames and --set to a command."""
    command.add_argument("scene", type=Path, help="scene.toml")
    command.add_argument("--contact", metavar="NAME", help="contact model (`tkamb contact list`)")
    command.add_argument("--resolution", type=float, metavar="MM", help="spacing of the map points")
    command.add_argument("--out", type=Path, metavar="DIR", help="output folder")
    command.add_argument("--frames", type=_frames, metavar="A:B:STEP", help="frames, as in Python")
    add_set(command)


def add_set(command: Any) -> None:
    """Add --set to a command."""
    command.add_argument(
        "--set",
        action="append",
        default=[],
        type=_setting,
        metavar="TABLE.KEY=VALUE",
        help="override a key of the scene; a list in brackets and quotes: "
        "--set 'contact.released=[\"adduction\"]'",
    )


def add_preset(command: Any) -> None:
    """Add --as to a command."""
    command.add_argument(
        "--as",
        dest="preset",
        metavar="NAME",
        help="apply a study's own choices to the scene: sharma-2008; --set still overrides them",
    )


def add_force(command: argparse.ArgumentParser) -> None:
    """Add --force to a command that writes one file."""
    command.add_argument(
        "--force", action="store_true", help="--out may replace a file that tkamb did not write"
    )


def overrides_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return dotted key -> value of what `add_scene_options` was given."""
    overrides = dict(options.set)
    if options.contact:
        overrides["contact.model"] = options.contact
    if options.resolution is not None:
        overrides["contact.resolution_mm"] = options.resolution
    return overrides


def _frames(text: str) -> slice:
    from tkamb.run.frame_choice import frames_slice

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
