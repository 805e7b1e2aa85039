"""Which loads of the knee act at one frame: a condyle may be lifted, the extensor muscle slack.

Lines pull and contacts push: N_medial, N_lateral, the muscle's tension, PL and PF along its normal
are >= 0. A load is left out only where it would have the wrong sign: a condyle would have to pull,
or a muscle to push. A residual moment then takes its place. There are at most six sets: no condyle,
the medial or the lateral one lifted, each with the extensor mechanism taut or slack. The recorded
gap may exclude some of them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

from tkamb.knee.unknowns import MUSCLE, Solution


@dataclass(frozen=True)
class LoadStateSettings:
    """Which parts of the extensor carry load."""

    force_rounding: float = 1e-6
    """N: a force of the wrong sign that is smaller is rounding. Chosen: above rounding."""
    patella_moment: float = 0.25
    """N m: moment of the patella's own weight and inertia, up to 5 N on an arm of 45 mm. Chosen: it
    separates an extensor that carries from one that is slack."""


LOAD_STATE = LoadStateSettings()


PATELLAR_LOADS = ("patellar_ligament", "patellofemoral")


class LoadState(NamedTuple):
    """Loads that are zero.

    Args:
        lifted: sides of the condyles that carry nothing.
        slack: muscles of the extensor mechanism, where it carries nothing; else empty.
    """

    lifted: frozenset[str]
    slack: frozenset[str]

    @property
    def label(self) -> str:
        """The loads that are zero, in words."""
        left_out = [f"{side} lifted" for side in sorted(self.lifted)]
        left_out += [f"{muscle} slack" for muscle in sorted(self.slack)]
        return " and ".join(left_out) or "all loaded"


def load_states(
    sides: Iterable[str], off: frozenset[str], extensors: Iterable[str]
) -> list[LoadState]:
    """Return the sets to try, fewest zero loads first, a slack muscle before a lifted condyle.

    If several sets hold, the first is preferred: the recorded gap shows contact, while nothing
    recorded shows the muscle's activity.

    Args:
        sides: of the condyles that are modelled.
        off: sides that the recorded gap keeps off the insert.
        extensors: names of the extensor muscles; none: the mechanism is not modelled.
    """
    near = [side for side in sides if side not in off]
    lifted = [off, *(off | {side} for side in near if len(near) == 2)]
    slack = dict.fromkeys([frozenset[str](), frozenset(extensors)])
    states = [LoadState(*state) for state in product(lifted, slack)]
    return sorted(
        states, key=lambda state: (len(state.lifted) + bool(state.slack), len(state.lifted))
    )


def _muscles(values: Mapping[str, float]) -> list[str]:
    return [name for name in values if name.startswith(MUSCLE)]


def wrong_signs(state: LoadState, solution: Solution) -> list[str]:
    """Return the contradictions to a set's own assumptions, with their size; empty if they hold."""
    if not solution.regular:
        return ["singular equations"]
    values = solution.values
    one_sided = ("medial_normal", "lateral_normal", *_muscles(values), *PATELLAR_LOADS)
    wrong = [
        f"{name.removeprefix(MUSCLE).replace('_', ' ')} {values[name]:.3g} N"
        for name in one_sided
        if values.get(name, 0.0) < -LOAD_STATE.force_rounding
    ]
    if state.slack:
        # on the tibia, about insert z; without contact it is given on the femur
        extension = values.get("residual_flexion", 0.0) - values.get("knee_moment_flexion", 0.0)
        if extension > LOAD_STATE.patella_moment:
            wrong.append(f"extension moment {extension:.3g} N·m needed")
    return wrong


def contradictions(
    state: LoadState, solutions: Mapping[LoadState, Solution], off: frozenset[str]
) -> list[str]:
    """Return what is wrong with one of the sets: its signs, or a load left out that would act.

    Args:
        state: the set.
        solutions: of all sets.
        off: sides that the recorded gap keeps off the insert.
    """
    wrong = wrong_signs(state, solutions[state])
    if state.slack:
        taut = solutions[LoadState(state.lifted, frozenset())].values
        pulls = {name: taut[name] for name in (*_muscles(taut), "patellar_ligament")}
        if not min(pulls.values()) < -LOAD_STATE.force_rounding:
            name, pull = next(iter(pulls.items()))
            wrong.append(f"{name.removeprefix(MUSCLE)} would pull with {pull:.3g} N")
    for side in sorted(state.lifted - off):
        alternative = solutions[LoadState(state.lifted - {side}, state.slack)]
        force = alternative.values[f"{side}_normal"]
        if not force < 0.0:
            wrong.append(f"{side} condyle would push with {force:.3g} N")
    return wrong
