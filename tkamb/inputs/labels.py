"""Marker labels: the same marker is `R.Thigh.Superior`, `RThighSuperior`, `JW:RThighSuperior`."""

from collections.abc import Iterable


def plain_label(label: str) -> str:
    """Return a label without the subject's prefix, dots, underscores, blanks and case."""
    name = label.rpartition(":")[2]
    return "".join(c for c in name if c not in "._- ").lower()


def matched_labels(names: Iterable[str], labels: Iterable[str]) -> dict[str, str]:
    """Return name -> the recording's label, for the names that it holds.

    An exact label comes first, then one that is the same when both are plain. A plain label
    that stands twice in the recording (two subjects) matches nothing.
    """
    labels = list(labels)
    plain: dict[str, list[str]] = {}
    for label in labels:
        plain.setdefault(plain_label(label), []).append(label)
    found = {}
    for name in names:
        candidates = [name] if name in labels else plain.get(plain_label(name), [])
        if len(candidates) == 1:
            found[name] = candidates[0]
    return found
