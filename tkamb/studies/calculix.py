"""CalculiX: one contact problem as it reads it, its run as a process, the numbers that it prints.

The deck: hexahedra, a rigid patch, penalty contact, a load. The femoral patch is a rigid layer of
wedges that may move along y only. It begins at a guessed depth in the insert and is let go under
the whole load: CalculiX closes the overlap and finds the balance in one increment, or in as many as
it needs. Contact is node to surface, so that a node carries its pressure times its share of the
deformed faces around it. The run: one thread, a limit of time, its own peak memory.
"""

import math
import os
import shutil
import subprocess
import tempfile
import time as clock
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.materials import LinearElastic, Material, RambergOsgood
from tkamb.contact.pair import Bearing
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface
from tkamb.memory import peak_rss
from tkamb.studies.measures import ONE_THREAD
from tkamb.units import MEGAPASCAL, MILLIMETRE

PENALTY = 1e5
"""N/mm³: contact gives way by 0.3 µm at 30 MPa."""
PATCH_THICKNESS = np.array([0.0, 1e-3, 0.0])
"""m: of the layer of wedges that stands for the rigid femoral component."""
PROGRAM = "ccx"
LONGEST_SECONDS = 600.0
"""A run that takes longer is stopped and says so."""
OUTPUT_FILE = "output"
POLL_SECONDS = 0.05
"""Between two looks at the process's memory."""


@dataclass(frozen=True, eq=False)
class Deck:
    """What CalculiX is asked.

    Args:
        lattice: nodes and hexahedra of the insert.
        patch: the part of the femoral component that can touch, insert frame, where it begins.
        material: of the insert.
        bearing: how the bottom is held.
        load: N, along -y.
        element: "C3D8" (fully integrated, locks as nu nears 0.5), "C3D8I" (incompatible modes).
    """

    lattice: Lattice
    patch: Surface
    material: Material
    bearing: Bearing
    load: float
    element: str

    @property
    def text(self) -> str:
        """The input in mm, N and MPa.

        Raises:
            InputError: the material's law or the bearing is not one of CalculiX's here.
        """
        return "\n".join([*self._mesh(), *self._sets(), *self._solids(), *self._step(), ""])

    @property
    def _centre(self) -> int:
        """Number of the node that moves the rigid patch."""
        return len(self.lattice.nodes) + 2 * len(self.patch.vertices) + 1

    def _mesh(self) -> list[str]:
        lattice, patch, n = self.lattice, self.patch, len(self.lattice.nodes)
        places = np.concatenate([lattice.nodes, patch.vertices, patch.vertices + PATCH_THICKNESS])
        wedges = patch.faces[:, [0, 2, 1]] + n
        wedges = np.concatenate([wedges, wedges + len(patch.vertices)], axis=1)
        lines = ["*NODE, NSET=NALL"]
        for number, (x, y, z) in enumerate(places / MILLIMETRE, 1):
            lines.append(f"{number},{x:.9e},{y:.9e},{z:.9e}")
        lines += [f"{self._centre},0.,30.,0.", f"{self._centre + 1},0.,30.,0."]
        lines += [f"*ELEMENT, TYPE={self.element}, ELSET=INSERT", *_numbered(1, lattice.cells)]
        lines.append("*ELEMENT, TYPE=C3D6, ELSET=FEMUR")
        return lines + _numbered(len(lattice.cells) + 1, wedges)

    def _sets(self) -> list[str]:
        n, m = len(self.lattice.nodes), len(self.patch.vertices)
        first = len(self.lattice.cells) + 1
        lines = _set("NBOTTOM", self.lattice.bottom_nodes)
        lines += _set("NREF", np.array([self._centre - 1])) + _set("NINSERT", np.arange(n))
        lines += _set("NSLAVE", np.unique(self.lattice.contact_triangles))
        lines += _set("NFEMUR", np.arange(n, n + 2 * m))
        lines += ["*SURFACE, NAME=SLAVE, TYPE=NODE", "NSLAVE", "*SURFACE, NAME=MASTER"]
        return lines + [f"{first + e},S1" for e in range(len(self.patch.faces))]

    def _solids(self) -> list[str]:
        return [
            *("*MATERIAL, NAME=INSERT", *_law(self.material)),
            *("*MATERIAL, NAME=STEEL", "*ELASTIC", "2.1E5,0.3"),
            "*SOLID SECTION, ELSET=INSERT, MATERIAL=INSERT",
            "*SOLID SECTION, ELSET=FEMUR, MATERIAL=STEEL",
            f"*RIGID BODY, NSET=NFEMUR, REF NODE={self._centre}, ROT NODE={self._centre + 1}",
            *("*SURFACE INTERACTION, NAME=SI", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"),
            f"{PENALTY},0.001",
            "*CONTACT PAIR, INTERACTION=SI, TYPE=NODE TO SURFACE",
            "SLAVE,MASTER",
        ]

    def _step(self) -> list[str]:
        if self.bearing != "fixed":
            raise InputError("holds its inserts by the whole bottom", "CalculiX's deck")
        centre, finite = self._centre, "" if self.material.is_linear else ", NLGEOM"
        return [
            *("*BOUNDARY", "NBOTTOM,1,3", f"{centre},1,1", f"{centre},3,3", f"{centre + 1},1,3"),
            *("*STEP, INC=300" + finite, "*STATIC", "1.,1.,1e-7,1."),
            *("*CLOAD", f"{centre},2,{-self.load}"),
            *("*NODE PRINT, NSET=NREF, FREQUENCY=1000", "U"),
            *("*NODE PRINT, NSET=NINSERT, FREQUENCY=1000", "U"),
            *("*CONTACT PRINT, FREQUENCY=1000", "CSTR", "*END STEP"),
        ]


def _law(material: Material) -> list[str]:
    modulus, ratio, law = material.young_modulus / MEGAPASCAL, material.poisson_ratio, material.law
    if isinstance(law, RambergOsgood):
        stress = law.reference_stress / MEGAPASCAL
        return ["*DEFORMATION PLASTICITY", f"{modulus},{ratio},{stress},{law.exponent},{law.alpha}"]
    if isinstance(law, LinearElastic):
        return ["*ELASTIC", f"{modulus},{ratio}"]
    raise InputError("has no law that CalculiX knows", f"material '{material.name}'")


def _numbered(first: int, members: Index) -> list[str]:
    return [f"{i},{','.join(str(v + 1) for v in row)}" for i, row in enumerate(members, first)]


def _set(name: str, nodes: Index) -> list[str]:
    return [f"*NSET, NSET={name}", *(str(v + 1) for v in nodes)]


@dataclass(frozen=True, eq=False)
class PeerRun:
    """What one run of CalculiX gave and took.

    Args:
        blocks: the last block of numbers of each kind in its .dat file, by the first word.
        seconds: of the process.
        peak_rss_MB: of the process (1e6 bytes).
        iterations: equilibrium iterations, one factorisation each.
    """

    blocks: dict[str, Array]
    seconds: float
    peak_rss_MB: float
    iterations: int


def find_program() -> str:
    """Return where CalculiX is.

    Raises:
        InputError: it is not installed.
    """
    found = shutil.which(PROGRAM)
    if found is None:
        raise InputError("is not installed", "CalculiX", "apt-get install calculix-ccx")
    return found


def run_calculix(text: str, longest: float = LONGEST_SECONDS) -> PeerRun:
    """Run a deck.

    Args:
        text: the input.
        longest: s, after which it is stopped.

    Raises:
        InputError: CalculiX is not installed.
        ComputationError: it stopped with an error, or was stopped.
    """
    program = find_program()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "peer.inp").write_text(text, encoding="utf-8")
        start = clock.perf_counter()
        memory = _wait([program, "-i", "peer"], place, longest)
        seconds = clock.perf_counter() - start
        if not (place / "peer.dat").exists():
            raise ComputationError(
                f"gave no output: {_last_words(place / OUTPUT_FILE)}", "CalculiX"
            )
        blocks = _blocks((place / "peer.dat").read_text(encoding="utf-8").splitlines())
        iterations = _iterations((place / "peer.cvg").read_text(encoding="utf-8"))
        return PeerRun(blocks, seconds, memory, iterations)


def _wait(command: list[str], place: Path, longest: float) -> float:
    """Run a command to its end with one thread; return its peak memory, MB."""
    memory, start = math.nan, clock.perf_counter()
    with (
        open(place / OUTPUT_FILE, "wb") as output,
        subprocess.Popen(
            command, cwd=place, stdout=output, stderr=subprocess.STDOUT, env=os.environ | ONE_THREAD
        ) as process,
    ):
        try:
            while process.poll() is None:
                memory = float(np.fmax(memory, peak_rss(process.pid)))  # NaN once it has ended
                if clock.perf_counter() - start > longest:
                    raise ComputationError(f"stopped after {longest:g} s", "CalculiX")
                with suppress(subprocess.TimeoutExpired):
                    process.wait(POLL_SECONDS)
        finally:
            process.kill()
    if process.returncode:
        raise ComputationError(f"stopped: {_last_words(place / OUTPUT_FILE)}", "CalculiX")
    return memory


def _last_words(path: Path) -> str:
    """Return the line that says what went wrong, or the last one."""
    lines = [line.strip(" *") for line in path.read_text(errors="replace").splitlines()]
    lines = [line for line in lines if line]
    wrong = [line for line in lines if line.lower().startswith("error")]
    return (wrong or lines or ["it said nothing"])[-1]


def _iterations(text: str) -> int:
    """Count the lines of a .cvg file that belong to an iteration: step, increment, ..."""
    return sum(line.split()[:1] != [] and line.split()[0].isdigit() for line in text.splitlines())


def _blocks(lines: Iterable[str]) -> dict[str, Array]:
    """Return the blocks of numbers; a title's first word, and its set, name one."""
    blocks: dict[str, list[list[float]]] = {}
    rows: list[list[float]] = []
    for line in lines:
        words = line.split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            named = words[words.index("set") + 1] if "set" in words else words[0]
            rows = blocks[named] = []
            continue
        if numbers:
            rows.append(numbers)
    return {name: np.array(rows) for name, rows in blocks.items() if rows}
