"""What each muscle adds to the normal force of either condyle at one frame.

The equations of a frame are linear in all loads while pose, contact points, contact normals, the
direction of friction and every line of action stay. So the normal forces are the sum of what each
load causes by itself,

    N_side = N_side(weight, inertia and ground) + N_side(ligaments) + Σ_i N_side(muscle i)

(and N_side(post) where a cam on the insert's post is modelled). Each term is computed with all
other muscles and, except in their own term, the ligaments at zero force. A muscle alone leaves a
flexion moment at the knee. A moment about the insert's z balances it, beside the residuals that
balance the AP and ML force and the axial moment in every frame. The sum of these moments over all
terms is the knee's reserve. The extensor group acts through patella and patellar ligament, and is
one muscle here.

References: Winby et al., J Biomech 42:2294 (2009), doi:10.1016/j.jbiomech.2009.06.019;
Sasaki & Neptune, J Biomech 43:2780 (2010), doi:10.1016/j.jbiomech.2010.06.011.
"""

from dataclasses import replace

import numpy as np

from tkamb.knee import unknowns
from tkamb.knee.equations import KneeGeometry, KneeLoads, KneeSystem
from tkamb.knee.load_state import LoadState

EXTERNAL, LIGAMENTS, POST, EXTENSORS = "external", "ligaments", "post", "quadriceps"
"""Names beside the muscles': weight, inertia and ground; all bundles; a cam on the post, if it is
modelled; the extensor group."""


def condyle_contributions(
    geometry: KneeGeometry, loads: KneeLoads, friction: float
) -> dict[str, dict[str, float]]:
    """Return side -> load -> what it adds to the side's normal force, N; the sum is that force.

    Args:
        geometry: a frame with contact, extensor mechanism and the other muscles' share.
        loads: its solution; a side that is lifted has no contributions.
        friction: Coulomb coefficient of the femorotibial contact.
    """
    share, extensor = geometry.share, geometry.extensor
    if share is None or extensor is None or loads.problems:
        return {}
    slack = frozenset(extensor.muscles) if loads.slack else frozenset[str]()
    bare = replace(geometry, share=None, ligaments=(), post=())
    system = KneeSystem(bare, friction, LoadState(loads.lifted, slack))
    lines = share.lines.unit_loads(geometry.state)
    moment = unknowns.moment_pair("tibia", "femur", unknowns.AXES["ml"])
    constants = {LIGAMENTS: geometry.ligaments} | ({POST: geometry.post} if geometry.post else {})
    unit = system.response(geometry.state.generalised([*constants.values(), *lines, moment]))
    outside = np.array([system.solution.values[name] for name in system.names])
    force = share.force[share.crossing]
    pulls = np.concatenate([np.ones(len(constants)), force])
    caused = np.column_stack([outside, unit[:, :-1] * pulls])
    pulled = np.zeros(len(outside))
    if not slack:
        # The extensor group is a known load here; a flexion moment is the unknown in its place.
        row = system.names.index(unknowns.muscle_load(extensor.muscles[0]))
        per_newton = unit[:, -1] / unit[row, -1]
        caused = caused - np.outer(per_newton, caused[row])
        pulled = per_newton * extensor.tension(loads.values)
    names = [EXTERNAL, *constants, *(share.muscles[i] for i in share.crossing), EXTENSORS]
    caused = np.column_stack([caused, pulled])
    return {
        side: dict(zip(names, caused[system.names.index(f"{side}_normal")].tolist(), strict=True))
        for side in system.carrying
    }
