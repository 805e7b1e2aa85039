"""Slack ligaments.

The starter knee with its ligaments, and with longer slack lengths: a taut ligament pulls femur and
tibia together, so the contact carries its tension on top of what balances weight and muscle. Where
the slack knee's ligaments carry nothing, the difference of the contact forces is that tension.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tkamb
from tkamb.run.columns import is_ligament

SCENE = Path(tkamb.__file__).parent / "io" / "starter" / "files" / "scene.toml"

scene = tkamb.load_scene(SCENE, {"contact.model": "foundation", "contact.resolution_mm": 3.0})
longer = tuple(
    ligament.model_copy(update={"slack_length_mm": 1.15 * ligament.slack_length_mm})
    for ligament in scene.ligament
)
taut = tkamb.simulate(scene)
slack = tkamb.simulate(scene.model_copy(update={"ligament": longer}))


def tension(results):
    """Return the summed tension (f,) of all bundles, N."""
    return np.sum([results[name] for name in results.columns if is_ligament(name)], axis=0)


figure, axes = plt.subplots(figsize=(5.4, 3.4), layout="constrained")
for results, name, colour in ((taut, "as shipped", "#0072B2"), (slack, "slack", "#D55E00")):
    axes.plot(results["flexion_deg"], results["force_total_N"], "o-", color=colour, label=name)
axes.plot(taut["flexion_deg"], tension(taut), "k--", label="ligaments' tension, as shipped")
axes.set(xlabel="flexion (deg)", ylabel="contact force (N)")
axes.legend()
figure.savefig("slack_ligaments.png", dpi=100)

worst = int(np.argmax(tension(taut)))
more = (taut["force_total_N"] - slack["force_total_N"])[worst] / tension(taut)[worst]
assert 0.9 < more < 1.1, more
