"""The deck of one frame of a run, with what the run found for comparison."""

from dataclasses import dataclass
from pathlib import Path

from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.decks.calculix import Deck
from tkamb.decks.febio import febio_text
from tkamb.decks.problem import PressProblem, press_problem
from tkamb.errors import InputError
from tkamb.output.metrics import map_rows
from tkamb.results import Results
from tkamb.results_folder import read_results
from tkamb.run.rerun import case_of_results
from tkamb.units import MEGAPASCAL, MILLIMETRE

SUFFIX = {"ccx": ".inp", "feb": ".feb"}


@dataclass(frozen=True, eq=False)
class FramePress:
    """The contact of one frame as a finite-element problem, and what the run found there.

    Args:
        problem: the pose is the one at which the frame's map holds, the load the vertical sum
            of its nodal forces.
        approach: m, of that pose.
        peak_pressure: Pa, of the map.
        origin: which frame of what, by which contact model.
        post: N and Pa, force and peak pressure on the insert's post, which is not in the problem;
            zero where nothing presses it.
    """

    problem: PressProblem
    approach: float
    peak_pressure: float
    origin: str
    post: tuple[float, float] = (0.0, 0.0)

    def comments(self) -> tuple[str, ...]:
        """Return what whoever opens the deck must know."""
        problem, millimetres = self.problem, self.approach / MILLIMETRE
        force, pressure = self.post
        left = (
            f"Not in it: the cam, which in the run presses the post with {force:.6g} N, at most "
            f"{pressure / MEGAPASCAL:.6g} MPa.",
        )
        return (
            f"{self.origin}; written by tkamb; mm, N, MPa.",
            "Insert frame: x anterior, y superior, z lateral; no friction; the bottom is held.",
            f"{len(problem.lattice.cells)} hexahedra; load {problem.load:.6g} N along -y.",
            f"The run found: approach since first touch {millimetres:.6g} mm, peak pressure "
            f"{self.peak_pressure / MEGAPASCAL:.6g} MPa.",
            *(left if force > 0.0 else ()),
        )

    def deck(self, kind: str) -> str:
        """Return the input of CalculiX ("ccx") or FEBio ("feb").

        Raises:
            InputError: a material or bearing that the program's deck does not hold.
        """
        problem, said = self.problem, self.comments()
        if kind == "feb":
            return febio_text(problem, self.approach, (*said, "Compare Fy of femur.csv with it."))
        start = problem.depth / MILLIMETRE
        more = (
            f"The femoral patch begins {start:.6g} mm below first touch and is let go: its",
            "approach is that less the U2 of the set NREF; pressures stand in the .dat file, too.",
        )
        pair = problem.pair
        deck = Deck(
            problem.lattice, problem.patch, pair.material, pair.bearing, problem.load,
            comments=(*said, *more),
        )  # fmt: skip
        return deck.text


def frame_press(folder: Path, frame: int, resolution_mm: float | None = None) -> FramePress:
    """Return the contact of one frame of a folder of results.

    Args:
        folder: that `tkamb run` wrote.
        frame: row of results.csv; negative ones count from the end.
        resolution_mm: edge of the hexahedra; None: the run's spacing.

    Raises:
        InputError: no results, no such frame, one without a map or without load, or a scene
            that is no longer what was run.
        ComputationError: the load presses nothing together.
    """
    results = read_results(folder)
    count = len(results)
    if not -count <= frame < count:
        raise InputError(f"there is no frame {frame}", "--frame", f"0 to {count - 1}")
    frame %= count
    row, maps = map_rows(results).get(frame), results.maps
    if maps is None or row is None:
        raise InputError(f"frame {frame} has no pressure map", folder, "choose another --frame")
    load = -float(maps.nodal_force_N[row, :, 1].sum())
    if not load > 0:
        raise InputError(f"frame {frame} carries no load", folder, "choose another --frame")
    pair, spacing = _pair(results)
    pose = maps.femoral_pose[row]
    problem = press_problem(pair, load, pose, resolution_mm or spacing)
    model = (results.summary.get("contact") or {}).get("model")
    origin = f"Frame {frame} of {folder} by {model} at {spacing:g} mm"
    peak = float(maps.pressure_Pa[row].max())
    return FramePress(problem, pair.approach(pose), peak, origin, _post(results, frame))


def _post(results: Results, frame: int) -> tuple[float, float]:
    """Return force and peak pressure on the post in a frame, N and Pa; zero without."""
    if "post_force_N" not in results.columns or not results["post_force_N"][frame] > 0.0:
        return 0.0, 0.0
    force, peak = results["post_force_N"][frame], results["post_peak_pressure_MPa"][frame]
    return float(force), float(peak) * MEGAPASCAL


def _pair(results: Results) -> tuple[ContactPair, float]:
    """Return the two bodies of a run and the spacing of its map points, mm."""
    case = case_of_results(results)
    table, insert = case.scene.contact, case.scene.implant.insert
    assert table is not None and insert is not None
    assert case.femoral is not None and case.insert is not None
    pair = ContactPair(case.femoral, case.insert, material(table.material), insert.bearing)
    return pair, table.resolution_mm
