"""Another contact model on one frame, while one looks at it."""

from dataclasses import replace
from threading import Lock

import numpy as np

from tkamb.contact.registry import contact_names
from tkamb.equilibrium.contact_side import ContactSide
from tkamb.errors import TkambError
from tkamb.output.style import SIDE_COLOURS
from tkamb.units import MEGAPASCAL, MILLIMETRE
from tkamb.view.drawing import PressureMap
from tkamb.view.lattice_lines import lattice_lines
from tkamb.view.payload import packed_lattice, packed_map
from tkamb.view.run import Run


class ContactSwitch:
    """Computes a frame of a run with any contact model; each model is prepared once.

    Args:
        run: with [contact].
        peak: MPa, top of the colour scale of the page.
    """

    def __init__(self, run: Run, peak: float) -> None:
        self.run, self.peak = run, peak
        self._sides: dict[str, ContactSide] = {}
        self._lock = Lock()

    def models(self) -> tuple[str, ...]:
        """Return the names that can be asked for; none without [contact]."""
        return contact_names() if self.run.case.scene.contact else ()

    def answer(self, row: int, model: str) -> bytes:
        """Return map and plain words of one frame, packed.

        Args:
            row: row of the results.
            model: name of the contact model.

        Raises:
            TkambError: no such model or frame, or the model cannot be prepared.
        """
        if not 0 <= row < len(self.run.frames):
            raise TkambError(f"there is no frame {row}")
        with self._lock:
            return self._computed(row, model)

    def lattice(self) -> bytes:
        """Return the lines of the run's lattice, packed.

        Raises:
            TkambError: the insert cannot be meshed.
        """
        with self._lock:
            return packed_lattice(lattice_lines(self.run.case))

    def _computed(self, row: int, model: str) -> bytes:
        side = self._side(model)
        _, carried = side.frame(self.run.frames[row])
        points, triangles = side.state.points, side.state.triangles
        result = carried.result
        if result is None:
            nothing = PressureMap(points, triangles, *np.zeros((2, 1, len(points))))
            return packed_map(nothing, self.peak, f"{model}: {carried.problem}")
        found = PressureMap(points, triangles, result.pressure[None] / MEGAPASCAL, result.gap[None])
        parts = []
        for name in SIDE_COLOURS:
            condyle = getattr(result, name)
            if condyle is not None:
                parts.append(
                    f"{name} {condyle.force:.0f} N on {condyle.area / MILLIMETRE**2:.0f} mm², "
                    f"peak {condyle.peak_pressure / MEGAPASCAL:.1f} MPa"
                )
        words = [f"{model}: {'; '.join(parts)}", f"{carried.seconds:.2f} s", *carried.flags]
        if found.peak > self.peak:
            words.append(f"the map exceeds the colour scale ({self.peak:.1f} MPa)")
        return packed_map(found, self.peak, "; ".join(words))

    def _side(self, model: str) -> ContactSide:
        if model not in self._sides:
            case = self.run.case
            assert case.scene.contact is not None
            own = model == case.scene.contact.model
            changes = {"model": model} if own else {"model": model, "options": {}}
            contact = case.scene.contact.model_copy(update=changes)
            scene = case.scene.model_copy(update={"contact": contact})
            self._sides[model] = ContactSide(replace(case, scene=scene), self.run.mechanics)
        return self._sides[model]
