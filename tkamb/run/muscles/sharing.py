"""How muscles share the load: the options, and each frame's problem made of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array
from tkamb.io.opensim.model import OpenSimMuscle
from tkamb.run.muscles.hill import HILL
from tkamb.run.muscles.static_optimisation import LoadSharing, share_load


@dataclass(frozen=True, eq=False)
class EmgGuide:
    """What envelopes e ask of the activations a.

    - "target" adds Σ_i W (a_i - e_i)² to the cost, W the weight;
    - "bounds" holds a_i within e_i ± width, as far as that lies within the bounds of all.

    Args:
        envelope: (f, m) normalised; NaN for muscles without EMG.
        use: which of the two.
        size: W, or the width.
    """

    envelope: Array
    use: Literal["target", "bounds"]
    size: float

    def only(self, k: int) -> "EmgGuide":
        """Return that of frame k alone."""
        return replace(self, envelope=self.envelope[k : k + 1])

    def applied(self, problem: LoadSharing, k: int) -> LoadSharing:
        """Return the problem of frame k with its envelopes in it."""
        finite, expected = np.isfinite(self.envelope[k]), np.nan_to_num(self.envelope[k])
        if self.use == "target":
            spread = np.where(finite, self.size**-0.5, np.inf)
            return replace(problem, expected=expected, spread=spread)
        low, high = (
            np.clip(expected + sign * self.size, problem.lowest, problem.highest)
            for sign in (-1.0, 1.0)
        )
        return replace(
            problem,
            lowest=np.where(finite, low, problem.lowest),
            highest=np.where(finite, high, problem.highest),
        )


@dataclass(frozen=True)
class SharingSettings:
    """When a solution of the static optimisation is accepted."""

    kkt_tolerance: float = 1e-8
    """Relative: largest violation of the optimality conditions (Karush, Kuhn and Tucker) with which
    a frame is kept. Chosen: above what the solver leaves."""


SHARING = SharingSettings()


@dataclass(frozen=True)
class Sharing:
    """How muscles share the load.

    Args:
        muscles: names; None: those of the leg, see `leg_muscles`.
        coordinates: those that are balanced; None: hip, knee flexion, ankle, subtalar.
        reserve: ρ, N·m (N for a translation): the reserve that costs as much as one fully active
            muscle of weight 1, for all coordinates or by name; inf: free of cost, 0: none.
        exponent: p, at least 2.
        weights: "volume" (optimal fibre length times strength, over the mean), or "equal".
        lowest: least activation.
        highest: largest activation.
        law: "isometric" (F_i the maximal isometric force, nothing passive) or "hill", see
            `rigid_tendon_strength`.
    """

    muscles: tuple[str, ...] | None = None
    coordinates: tuple[str, ...] | None = None
    reserve: float | Mapping[str, float] = 10.0
    exponent: float = 2.0
    weights: Literal["volume", "equal"] = "volume"
    lowest: float = 0.0
    highest: float = 1.0
    law: Literal["isometric", "hill"] = "isometric"

    def reserves(self, coordinates: Sequence[str]) -> Array:
        """Return ρ (c,) of some coordinates."""
        if isinstance(self.reserve, Mapping):
            return np.array([float(self.reserve[name]) for name in coordinates])
        return np.full(len(coordinates), float(self.reserve))

    def check(self, coordinates: Sequence[str]) -> None:
        """Raise an InputError for what is out of range."""
        if isinstance(self.reserve, Mapping) and set(self.reserve) != set(coordinates):
            odd = sorted(set(self.reserve) ^ set(coordinates))
            raise InputError(f"reserve and coordinates differ in {', '.join(odd)}", "muscles")
        if not (self.reserves(coordinates) >= 0.0).all():
            raise InputError("a reserve is negative or no number", "muscles")
        if not (0.0 <= self.lowest < self.highest < np.inf and 2.0 <= self.exponent < np.inf):
            raise InputError(
                f"lowest {self.lowest:g}, highest {self.highest:g}, exponent {self.exponent:g}",
                "muscles",
                "0 <= lowest < highest and exponent >= 2",
            )


@dataclass(frozen=True, eq=False)
class FrameProblems:
    """All frames' problems; arrays as in `MuscleTrial`, forces as in `rigid_tendon_strength`.

    `guide`: what EMG asks of the activations, if anything.
    """

    muscles: list[OpenSimMuscle]
    coordinates: tuple[str, ...]
    sharing: Sharing
    moment: Array
    arms: Array
    active: Array
    passive: Array
    guide: EmgGuide | None = None

    def solved(self, k: int) -> tuple[Array, Array, float, str]:
        """Return activations (m,), reserves (c,), KKT residual and status of frame k."""
        reason = self._unknown(k)
        if reason is None:
            try:
                shared = share_load(self.frame(k))
            except ComputationError as error:
                reason = error.what
            else:
                if shared.kkt_residual < SHARING.kkt_tolerance:
                    return shared.activation, shared.others, shared.kkt_residual, "ok"
                reason = f"the conditions of the optimum are violated by {shared.kkt_residual:.1g}"
        nothing = np.full(len(self.muscles), np.nan), np.full(len(self.coordinates), np.nan)
        return *nothing, np.nan, f"failed: {reason}"

    def _unknown(self, k: int) -> str | None:
        """Return why frame k cannot be solved; None if it can."""
        if not np.isfinite(self.moment[k]).all():
            return "an external load is not known"
        for missing, why in (
            (~np.isfinite(self.arms[k]).all(axis=1), "no taut path of"),
            (
                ~np.isfinite(self.active[k]),
                f"fibres beyond {HILL.longest_fibre_ratio:g} optimal lengths in",
            ),
        ):
            if missing.any():
                names = [self.muscles[i].name for i in np.flatnonzero(missing)]
                return f"{why} {', '.join(names)}"
        return None

    def frame(self, k: int) -> LoadSharing:
        """Return the problem of frame k."""
        count, reserve = len(self.muscles), self.sharing.reserves(self.coordinates)
        none = reserve == 0.0
        transposed = self.arms[k].T
        problem = LoadSharing(
            weight=_weights(self.muscles, self.sharing),
            lowest=np.full(count, self.sharing.lowest),
            highest=np.full(count, self.sharing.highest),
            offset=self.moment[k] - transposed @ self.passive[k],
            gain=-transposed * self.active[k],
            lower=np.where(none, 0.0, -np.inf),
            upper=np.where(none, 0.0, np.inf),
            reserve=np.where(none, np.inf, reserve),
            exponent=self.sharing.exponent,
        )
        return problem if self.guide is None else self.guide.applied(problem, k)


def _weights(muscles: Sequence[OpenSimMuscle], sharing: Sharing) -> Array:
    """Return w (m,), 1 on average."""
    if sharing.weights == "equal":
        return np.ones(len(muscles))
    volume = np.array([m.optimal_fibre_length_m * m.max_isometric_force_N for m in muscles])
    return volume / volume.mean()
