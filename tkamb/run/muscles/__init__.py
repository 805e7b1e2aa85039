"""Muscle forces of a leg over a whole recording, by static optimisation.

- `tkamb.run.muscles.trial`: `solve_trial(model, motion, loads)` returns a `MuscleTrial`.
- `tkamb.run.muscles.sharing`: options and quadratic programmes of the frames.
- `tkamb.run.muscles.leg`: coordinates, muscles and Hill-type strength of a leg.
- `tkamb.run.muscles.knee_trial`: a leg with tkamb's knee in place of the OpenSim model's.
- `tkamb.run.muscles.shared_muscles`: the muscles of a scene with [muscles].
"""

from tkamb.run.muscles.sharing import Sharing
from tkamb.run.muscles.trial import MuscleTrial, solve_trial

__all__ = ["MuscleTrial", "Sharing", "solve_trial"]
