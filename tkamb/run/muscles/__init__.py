"""Muscles of a leg over a whole recording: their forces, and what they do to the bones.

- `tkamb.run.muscles.trial`: `solve_trial(model, motion, loads)` returns a `MuscleTrial`.
- `tkamb.run.muscles.sharing`: options, problems of the frames, one frame's quadratic programme.
- `tkamb.run.muscles.leg`: coordinates, muscles and Hill-type strength of a leg.
- `tkamb.run.muscles.knee_trial`: a leg whose knee is tkamb's, read from files.
- `tkamb.run.muscles.shared_muscles`: the muscles of a run's knee.

These modules are imported only when they are asked for.
"""

from tkamb.run.muscles.sharing import Sharing
from tkamb.run.muscles.trial import MuscleTrial, solve_trial

__all__ = ["MuscleTrial", "Sharing", "solve_trial"]
