"""All files of the model."""

from knee_bend import button, chain, readme, scene, tables
from knee_bend.extensor import patella_motion
from knee_bend.implant import FEMORAL, INSERT
from knee_bend.motion import knee_motion
from knee_bend.squat import squat
from tkamb.studies.designs import solids


def make(folder):
    """Write all files of the model into the folder."""
    for name, part in (("femoral_component", FEMORAL), ("insert", INSERT)):
        solids.write_stl(folder / f"{name}.stl", *part.mesh())
    solids.write_stl(folder / "patellar_button.stl", *button.mesh())
    motion = knee_motion()
    patella = patella_motion(motion.coordinates)
    body = squat(motion.time, motion.coordinates[:, 5])
    texts = {
        "motion.csv": tables.motion_csv(motion, patella),
        "tibia.csv": tables.tibia_csv(motion, body),
        "ground_reaction.csv": tables.ground_reaction_csv(motion, body),
        "patient.urdf": chain.urdf(motion.coordinates[0, 1]),
        "scene.toml": scene.scene_toml(motion.coordinates),
        "README.md": readme.readme(motion, patella, body),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
