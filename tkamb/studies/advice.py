"""What a trade-off says in sentences: the fastest model for an error, and how models compare."""

from collections.abc import Sequence
from statistics import median

from tkamb.studies.quantities import SIDES
from tkamb.studies.row import KEYS, Row

LIMITS = {
    "approach": (0.05,),
    "force": (0.03,),
    "mean_pressure": (0.05, 0.10),
    "peak_pressure": (0.02, 0.05, 0.10),
    "area": (0.05, 0.10),
    "map": (0.10,),
}
"""Errors for which the fastest model is named."""
NAMES = dict(zip(KEYS, (key.replace("_", " ") for key in KEYS), strict=True)) | {
    "force": "condyle force",
    "map": "the pressure map (L2)",
}
COMPARED_ON, COMPARED_AT_MM = "two condyles", 2.0
"""Case and cell size on which the default lattice is compared with finite elements."""
DEFAULT = "lattice"
WANTED_OF_FE, WANTED_OF_PEER = 20.0, 300.0
"""Times faster than `fe` and than CalculiX: what the lattice was meant to be."""

Setting = tuple[str, float]


def setting_of(row: Row) -> Setting:
    """Return the model with its options, and its cell size (mm)."""
    return row.job.label, row.job.resolution_mm


def bodies_of(case: str) -> str:
    """Return the name of a case's bodies: poses of one knee share them, varus is a pose too."""
    if case.endswith(" deg"):
        return case.split()[0]
    return {"varus": "two condyles"}.get(case, case)


def recommendations(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each limit: the fastest model that keeps it wherever it was tried.

    Only settings that were tried on all bodies are compared, by their median warm time over
    one case of each.
    """
    settings = _settings_on_all_bodies(rows)
    return [
        f"for at most {100 * limit:g} % in {NAMES[key]}, {_fastest(settings, key, limit)}"
        for key, limits in LIMITS.items()
        for limit in limits
    ]


def _settings_on_all_bodies(rows: Sequence[Row]) -> dict[Setting, list[Row]]:
    bodies = {bodies_of(row.job.case) for row in rows}
    found: dict[Setting, list[Row]] = {}
    for row in rows:
        found.setdefault(setting_of(row), []).append(row)
    return {
        setting: some
        for setting, some in found.items()
        if {bodies_of(row.job.case) for row in some} == bodies
    }


def _fastest(settings: dict[Setting, list[Row]], key: str, limit: float) -> str:
    worst = {
        setting: max(row.errors.get(key, float("inf")) for row in some)
        for setting, some in settings.items()
    }
    times = {setting: median(warm_by_bodies(some)) for setting, some in settings.items()}
    kept = [setting for setting, error in worst.items() if error <= limit]
    if kept:
        best = min(kept, key=lambda setting: times[setting])
        return f"the fastest is {_named(best)} ({milliseconds(times[best])} ms warm)"
    if not worst:
        return "nothing can be said: no setting was tried on all bodies"
    nearest = min(worst, key=lambda setting: worst[setting])
    return f"no setting: the nearest is {_named(nearest)} with {100 * worst[nearest]:.2g} %"


def warm_by_bodies(rows: Sequence[Row]) -> list[float]:
    """Return one warm time (s) for each pair of bodies, the median of its poses."""
    bodies = dict.fromkeys(bodies_of(row.job.case) for row in rows)
    return [
        median(row.measure.warm_seconds for row in rows if bodies_of(row.job.case) == body)
        for body in bodies
    ]


def milliseconds(seconds: float) -> str:
    """Return a time in ms with three digits."""
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _named(setting: Setting) -> str:
    return f"{setting[0]} at {setting[1]:g} mm"


def comparison(rows: Sequence[Row]) -> list[str]:
    """Return how the default lattice compares with finite elements, measured in this run."""
    some = [
        row
        for row in rows
        if row.job.case == COMPARED_ON and row.job.resolution_mm == COMPARED_AT_MM and row.errors
    ]
    by_label = {row.job.label: row for row in some}
    if DEFAULT not in by_label:
        return []
    own = by_label[DEFAULT]
    where = "is" if own.on_front else "is not"
    front = [
        f"{row.job.resolution_mm:g}"
        for row in rows
        if row.job.case == COMPARED_ON and row.job.label == DEFAULT and row.on_front
    ]
    lines = [
        f"{COMPARED_ON}, 2000 N, nonlinear, {COMPARED_AT_MM:g} mm: {DEFAULT} takes "
        f"{milliseconds(own.measure.warm_seconds)} ms a position (warm) and {where} on the front; "
        f"its cell sizes on the front: {', '.join(front) or 'none'} mm"
    ]
    for label, row in by_label.items():
        if label.startswith(("fe", "calculix")):
            lines.append(_against(label, row, own))
    return lines + _at_other_sizes(rows)


def _at_other_sizes(rows: Sequence[Row]) -> list[str]:
    """Return how the default lattice compares with the peer where it has other cell sizes."""
    some = [row for row in rows if row.job.case == COMPARED_ON and row.errors]
    own = {row.job.resolution_mm: row for row in some if row.job.label == DEFAULT}
    return [
        f"at {size:g} mm, {DEFAULT} {milliseconds(own[size].measure.warm_seconds)} ms: "
        + _against(row.job.label, row, own[size])
        for row in some
        if row.job.label.startswith("calculix")
        and (size := row.job.resolution_mm) != COMPARED_AT_MM
        and size in own
    ]


def _against(label: str, row: Row, own: Row) -> str:
    times = row.measure.warm_seconds / own.measure.warm_seconds
    wanted = WANTED_OF_PEER if label.startswith("calculix") else WANTED_OF_FE
    reached = "reached" if times >= wanted else "not reached"
    line = f"{label}: {milliseconds(row.measure.warm_seconds)} ms, {times:.3g} times as long"
    line += f" (wanted: {wanted:g}, {reached})"
    if label == "fe":
        line += "; it shares the lattice's stored response and solver"
    if label.startswith("calculix"):
        line += f"; {_apart(own, row)}; CalculiX has finite strain, the lattice small strain"
    return line


def _apart(own: Row, peer: Row) -> str:
    """Return how far the lattice is from the peer, in per cent of the peer."""
    a, b = own.measure.values, peer.measure.values
    if not a or not b:
        return "values not kept"
    load = sum(b[f"{side}_force"] for side in SIDES)
    peak = max(b[f"{side}_peak_pressure"] for side in SIDES)
    shares = {
        "approach": abs(a["approach"] / b["approach"] - 1),
        "peak pressure": max(abs(a[f"{s}_peak_pressure"] - b[f"{s}_peak_pressure"]) for s in SIDES)
        / peak,
        "condyle force": max(abs(a[f"{s}_force"] - b[f"{s}_force"]) for s in SIDES) / load,
    }
    said = ", ".join(f"{100 * share:.2g} % in {name}" for name, share in shares.items())
    return f"the lattice is off it by {said}"
