"""Muscles of a leg over a whole recording: who pulls how much, and what that does to the bones.

- `tkamb.muscles.trial`: `solve_trial(model, motion, loads)` returns a `MuscleTrial`.
- `tkamb.muscles.sharing`: options, and the frames' problems.
- `tkamb.muscles.leg`: the coordinates and muscles of a leg.
- `tkamb.muscles.hill`: force–length–velocity and passive curves, rigid tendon.
- `tkamb.muscles.bones`: what the muscles' lines do to femur, patella, tibia and foot.
- `tkamb.muscles.static_optimisation`: one frame's quadratic programme.

Nothing of this is imported unless it is asked for.
"""

from tkamb.muscles.sharing import Sharing
from tkamb.muscles.trial import MuscleTrial, solve_trial

__all__ = ["MuscleTrial", "Sharing", "solve_trial"]
