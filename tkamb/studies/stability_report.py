"""Stability for a reader: counts, every case that is not plainly converged, picture."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from tkamb.output.style import BLUE, GREY, ORANGE, VERMILLION, new_figure, settings
from tkamb.studies.verdict import KINDS, WRONG, Verdict

COLOURS = {"converged": BLUE, "flagged": ORANGE}


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """Return the counts by contact model, then the cases that failed, then the flagged ones."""
    lines = [f"{'contact':18s} {'cases':>5s} " + " ".join(f"{kind:>15s}" for kind in KINDS)]
    for model in [*dict.fromkeys(v.contact for v in verdicts), "all"]:
        some = [v for v in verdicts if model in (v.contact, "all")]
        counts = [sum(v.kind == kind for v in some) for kind in KINDS]
        lines.append(f"{model:18s} {len(some):5d} " + " ".join(f"{n:15d}" for n in counts))
    flagged = [v for v in verdicts if v.kind == "flagged" and not v.failed]
    better = [v for v in verdicts if v.kind == "converged" and v.expected not in (None, v.kind)]
    unknown = [v for v in verdicts if v.expected is None]
    groups = {"failed": [v for v in verdicts if v.failed], "flagged": flagged}
    groups |= {"better than stored": better, "no stored verdict": unknown}
    for title, some in groups.items():
        lines += ["", f"{title}: {len(some)}", *(_line(v) for v in some)]
    return lines


def _line(verdict: Verdict) -> str:
    was = f" (was {verdict.expected})" if verdict.expected not in (None, verdict.kind) else ""
    return f"  {verdict.contact}, {verdict.case}: {verdict.kind}{was}: {verdict.reason}"


def picture(verdicts: Sequence[Verdict]) -> Figure:
    """Return one dot per case: what was driven out against the distance from the reference."""
    groups = list(dict.fromkeys(_group(v) for v in verdicts))
    with settings():
        figure = new_figure(8.0, 1.6 + 0.2 * len(groups))
        axis = figure.subplots()
        for kind in KINDS:
            some = [v for v in verdicts if v.kind == kind]
            if not some:
                continue
            axis.plot(
                [_distance(v) for v in some],
                [groups.index(_group(v)) for v in some],
                "o" if kind in COLOURS else "X",
                color=COLOURS.get(kind, VERMILLION),
                ms=4 if kind in COLOURS else 7,
                alpha=0.75,
                label=f"{kind.replace('_', ' ')} ({len(some)})",
            )
        axis.axvline(WRONG, color=GREY, lw=1, ls="--")
        top = len(groups) - 0.3
        axis.text(WRONG, top, "wrong beyond 2 % ", color=GREY, fontsize=7.5, ha="right")
        axis.text(1.0, top, "no answer", color=GREY, fontsize=7.5, ha="center")
        axis.set(xscale="log", xlim=(1e-9, 3.0), xlabel="largest distance from the reference")
        axis.set_yticks(range(len(groups)), groups, fontsize=7.5)
        axis.set_ylim(-0.7, len(groups) + 0.4)
        figure.legend(loc="outside upper left", ncols=4)
    return figure


def _distance(verdict: Verdict) -> float:
    return 1.0 if verdict.error is None else max(verdict.error, 2e-9)


def _group(verdict: Verdict) -> str:
    """Return the quantities that were driven out, or the run's kind."""
    if verdict.contact == "run":
        return " ".join(verdict.case.split()[:2])
    if verdict.contact != "lattice":
        return f"{verdict.contact}, any"
    names = [part.split("=")[0].rsplit("_", 1)[0] for part in verdict.case.split(", ")]
    return " and ".join(names)
