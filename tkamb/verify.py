"""Whether a folder still holds what a run wrote, and whether its inputs are still the same."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tkamb.code_identity import code_identity
from tkamb.errors import InputError
from tkamb.files import sha256_of
from tkamb.claim import settle
from tkamb.results import SUMMARY_NAME, differences, read_results, read_summary


@dataclass(frozen=True)
class Verdict:
    """What was found of a folder of results.

    Args:
        differs: what is not as it was written, a line each.
        notes: what a reader should know though the results are whole.
        inputs: how many input files were looked at.
    """

    differs: tuple[str, ...]
    notes: tuple[str, ...]
    inputs: int

    def lines(self) -> list[str]:
        """Return the verdict as lines of text."""
        end = f"results and {self.inputs} input file(s) are as they were when it was written"
        return [*self.differs, *self.notes, *([] if self.differs else [end])]


def verify_results(directory: str | Path) -> Verdict:
    """Hold a folder against the SHA-256 that its summary.json records.

    What a kill left to be put in place is put there first.

    Raises:
        InputError: it is not a folder of results.
    """
    directory = Path(directory)
    settle(directory)
    summary = read_summary(directory)
    if not isinstance(summary.get("versions"), Mapping):
        raise InputError("was not written by tkamb run", directory / SUMMARY_NAME)
    found = differences(directory, summary)
    if not isinstance(summary.get("files"), Mapping):
        found.append("carries no SHA-256: written by an earlier tkamb, nothing can be said")
    try:
        read_results(directory, check=False)
    except InputError as error:
        found.append(str(error))
    inputs = summary.get("inputs")
    inputs = inputs if isinstance(inputs, Mapping) else {}
    found += [line for path, recorded in inputs.items() if (line := _input(path, recorded))]
    return Verdict(tuple(found), tuple(_notes(summary)), len(inputs))


def _input(path: str, recorded: str) -> str | None:
    """Return in words what is wrong with an input file; None if it is the one that was read."""
    try:
        same = sha256_of(path) == recorded
    except InputError as error:
        return f"input {error}"
    return None if same else f"input {path} has changed since it was read"


def _notes(summary: Mapping[str, Any]) -> list[str]:
    identity = summary.get("identity")
    identity = identity if isinstance(identity, Mapping) else {}
    notes, made_by = [], identity.get("version of tkamb")
    if made_by != version("tkamb") or identity.get("code of tkamb") != code_identity():
        notes.append(f"computed by other code (tkamb {made_by}; this is {version('tkamb')})")
    if summary.get("unfinished_frames"):
        notes.append(f"unfinished: {summary['unfinished_frames']} frames are still to be computed")
    return notes
