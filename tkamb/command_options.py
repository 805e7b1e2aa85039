"""Options that several commands have."""

import argparse
from typing import Any

from tkamb.errors import InputError


def add_no_cache(command: argparse.ArgumentParser) -> None:
    """Add --no-cache to a command."""
    command.add_argument(
        "--no-cache", action="store_true", help="neither read nor keep prepared operators on disk"
    )


def without_cache(contact: str | None) -> dict[str, Any]:
    """Return the options of a contact model that then keeps nothing on disk.

    Raises:
        InputError: there is no such model, or it keeps nothing anyway.
    """
    from tkamb.contact.registry import contact_options

    if contact is None:
        raise InputError("no contact is modelled", "--no-cache", "leave it out")
    if "cache" not in contact_options(contact):
        raise InputError(f"'{contact}' keeps nothing on disk", "--no-cache", "leave it out")
    return {"cache": False}
