"""Muscles of a leg over a whole recording: who pulls how much, and what that does to the bones.

- `tkamb.run.muscles.trial`: `solve_trial(model, motion, loads)` returns a `MuscleTrial`.
- `tkamb.run.muscles.sharing`: options, and the frames' problems.
- `tkamb.run.muscles.leg`: the coordinates and muscles of a leg.
- `tkamb.run.muscles.hill`: force–length–velocity and passive curves, rigid tendon.
- `tkamb.run.muscles.bones`: what the muscles' lines do to femur, patella, tibia and foot.
- `tkamb.run.muscles.static_optimisation`: one frame's quadratic programme.

Nothing of this is imported unless it is asked for.
"""

from tkamb.run.muscles.sharing import Sharing
from tkamb.run.muscles.trial import MuscleTrial, solve_trial

__all__ = ["MuscleTrial", "Sharing", "solve_trial"]
