"""The picture of the stability study: one dot per case."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from tkamb.show.style import BLUE, GREY, ORANGE, VERMILLION, new_figure, settings
from tkamb.studies.verdict import KINDS, VERDICT, Verdict

COLOURS = {"converged": BLUE, "flagged": ORANGE}


def picture(verdicts: Sequence[Verdict]) -> Figure:
    """Return one dot per case: its extreme parameter against the distance from the reference."""
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
        axis.axvline(VERDICT.max_error, color=GREY, lw=1, ls="--")
        top = len(groups) - 0.3
        words = "wrong beyond 2 %; closed forms beyond their own bound "
        axis.text(VERDICT.max_error, top, words, color=GREY, fontsize=7.5, ha="right")
        axis.text(1.0, top, "no answer", color=GREY, fontsize=7.5, ha="center")
        axis.set(xscale="log", xlim=(1e-9, 3.0), xlabel="largest distance from the reference")
        axis.set_yticks(range(len(groups)), groups, fontsize=7.5)
        axis.set_ylim(-0.7, len(groups) + 0.4)
        figure.legend(loc="outside upper left", ncols=4)
    return figure


def _distance(verdict: Verdict) -> float:
    return 1.0 if verdict.error is None else max(verdict.error, 2e-9)


def _group(verdict: Verdict) -> str:
    """Return the extreme parameters, or the run's kind."""
    if verdict.contact == "run":
        return " ".join(verdict.case.split()[:2])
    if verdict.contact != "lattice":
        return f"{verdict.contact}, any"
    names = [part.split("=")[0].rsplit("_", 1)[0] for part in verdict.case.split(", ")]
    return " and ".join(names)
