"""Examples at the end of each command's --help. The tests parse every example."""

import argparse

from tkamb.commands.options import leaf_parsers

EXAMPLES: dict[str, tuple[str, ...]] = {
    "new": (
        "tkamb new my_knee",
        "tkamb new p17 --side left --mass-kg 92 --height-mm 1830 --sex female",
    ),
    "methods": ("tkamb methods out/my_knee", "tkamb methods out/my_knee > methods.txt"),
    "settings": ("tkamb settings", "tkamb settings lattice --json"),
    "live": (
        "tkamb live my_knee/scene.toml",
        "tkamb live out/my_knee --frame 60 --contact lattice --out kept",
    ),
    "check": (
        "tkamb check my_knee/scene.toml",
        "tkamb check my_knee/scene.toml --set patient.mass_kg=82 --out check.html",
    ),
    "run": (
        "tkamb run my_knee/scene.toml",
        "tkamb run my_knee/scene.toml --contact foundation --resolution 2 --frames 0:100:5 "
        "--out out/quick",
        "tkamb run my_knee/scene.toml --pack my_knee.zip",
    ),
    "verify": ("tkamb verify out/my_knee", "tkamb verify my_knee.zip --rerun"),
    "report": ("tkamb report out/my_knee", "tkamb report out/quick"),
    "compare": (
        "tkamb compare out/thick out/thin",
        "tkamb compare out/a out/b out/c --axis flexion --out out/designs",
    ),
    "press": (
        "tkamb press femoral.stl insert.stl --load 2000",
        "tkamb press femoral.stl insert.stl --load 1500 --units m --axes=-x,+y,-z "
        "--contact lattice --json",
    ),
    "contact list": ("tkamb contact list", "tkamb contact list | grep lattice"),
    "mesh check": ("tkamb mesh check insert.stl", "tkamb mesh check femoral.stl insert.stl --json"),
    "mesh part": (
        "tkamb mesh part parts.stl 1 --out insert.stl",
        "tkamb mesh part parts.stl 2 --out femoral.ply",
    ),
    "mesh lattice": (
        "tkamb mesh lattice insert.stl --resolution 2",
        "tkamb mesh lattice insert.stl --units m --axes=-x,+y,-z --out lattice.vtu",
    ),
    "scene": ("tkamb scene --schema", "tkamb scene --schema > scene.schema.json"),
    "import": (
        "tkamb import model.osim --c3d walk.c3d --side right --mass-kg 67 --cycle --out patient",
        "tkamb import model.osim --motion ik.mot --grf grf.mot --side left --mass-kg 80 "
        "--femoral femoral.stl --insert insert.stl --mesh-unit m --mesh-axes=-x,+y,-z "
        "--out patient",
    ),
    "data get": ("tkamb data get dm", "tkamb data get dm --from downloads --to data/dm"),
    "export": (
        "tkamb export out/my_knee --sto my_knee.sto",
        "tkamb export out/my_knee --vtp --out out/maps",
        "tkamb export out/my_knee --figures --out figures",
    ),
    "view": (
        "tkamb view out/my_knee",
        "tkamb view my_knee/scene.toml --contact foundation --html my_knee.html",
    ),
    "tradeoff": ("tkamb tradeoff --quick", "tkamb tradeoff my_knee/scene.toml --out out/tradeoff"),
    "stability": ("tkamb stability --quick", "tkamb stability --workers 4 --out out/stability"),
    "wear": (
        "tkamb wear my_knee/scene.toml --cycles 5e6",
        "tkamb wear my_knee/scene.toml --simulator profile.csv --updates 20 --out out/wear",
    ),
    "uncertainty": (
        "tkamb uncertainty my_knee/scene.toml --screen",
        "tkamb uncertainty my_knee/scene.toml --samples 128 --workers 4 --out out/bands",
    ),
    "cohort": (
        "tkamb cohort cohort.toml --workers 4",
        "tkamb cohort cohort.toml --shard 1/8 --out out/cohort",
    ),
}


def add_examples(parser: argparse.ArgumentParser) -> None:
    """Write the examples at the end of the help of each command of a parser."""
    for command, leaf in leaf_parsers(parser):
        examples = EXAMPLES.get(command)
        if examples:
            leaf.formatter_class = argparse.RawDescriptionHelpFormatter
            leaf.epilog = "\n  ".join(["examples:", *examples])
