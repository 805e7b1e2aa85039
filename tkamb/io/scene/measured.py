"""The tables of what was measured beside the motion: forces of an implant, surface EMG."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from tkamb.io.scene.table import FORMAT, Number, SceneTable, TableFormat


class MeasuredTable(SceneTable):
    """Axial knee forces of an instrumented implant: compared with the run, never used in it."""

    file: Path
    format: TableFormat | None = Field(None, description=FORMAT)
    columns: dict[Literal["time", "total", "medial", "lateral"], str | dict[str, Number]] = Field(
        description="role -> column, or a sum of columns {column = factor}; of total, medial and "
        "lateral at least one, the third follows from the other two; compression is positive; "
        "time is in s, by default the column of that name"
    )
    unit: Literal["N", "kN", "lbf"] = Field(description="of the forces")
    offset_s: Number = Field(
        description="added to the file's clock it is that of [motion]; 0 where they are one"
    )

    @model_validator(mode="after")
    def _columns_are_complete(self) -> Self:
        if not set(self.columns) - {"time"}:
            raise ValueError("'columns' names no force: total, medial or lateral")
        if isinstance(self.columns.get("time"), dict):
            raise ValueError("'columns' time is one column, no sum")
        if any(column == {} for column in self.columns.values()):
            raise ValueError("'columns' holds an empty sum")
        return self


Positive = Annotated[Number, Field(gt=0)]


class EmgTable(SceneTable):
    """Surface EMG: envelopes to compare the activations with, or to guide them.

    An envelope is the rectified signal, low-passed without phase shift, over its normalising
    value.
    """

    file: Path = Field(description="a .c3d with the channels, or a table that holds them")
    time: str = Field("time", description="of a table: the column of times, s")
    offset_s: Number = Field(
        0.0,
        description="added to the file's clock it is that of [motion]; an electromechanical delay "
        "may be added to it",
    )
    channels: dict[str, tuple[str, ...]] = Field(
        description="channel -> muscles of the model that it stands for"
    )
    high_pass_Hz: Positive | Literal["none"] = Field(
        description="before it is rectified, against movement of the electrodes"
    )
    cutoff_Hz: Positive = Field(description="low-pass of the rectified signal")
    normalised_by: Literal["recording"] | dict[str, Positive] = Field(
        "recording",
        description="the envelope's largest value in the file, or channel -> value in its unit",
    )
    use: Literal["report", "target", "bounds"] = Field(
        "report",
        description="report: agreement with the activations, nothing else; target: adds "
        "weight (a - e)^2 to the cost; bounds: a within e - width and e + width",
    )
    weight: Positive | None = Field(None, description="of use = 'target'")
    width: Annotated[Number, Field(gt=0, le=1)] | None = Field(
        None, description="of use = 'bounds', as an activation"
    )

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        for key, use in (("weight", "target"), ("width", "bounds")):
            if (getattr(self, key) is not None) != (self.use == use):
                raise ValueError(f"'{key}' belongs to use = '{use}', and is needed there")
        if not self.channels or not all(self.channels.values()):
            raise ValueError("'channels' names no channel, or a channel without a muscle")
        muscles = [name for names in self.channels.values() for name in names]
        twice = sorted({name for name in muscles if muscles.count(name) > 1})
        if twice:
            raise ValueError(f"'channels' names the muscle '{twice[0]}' twice")
        if isinstance(self.normalised_by, dict) and set(self.normalised_by) != set(self.channels):
            raise ValueError("'normalised_by' needs a value for each of the 'channels', no others")
        return self

    @property
    def sentence(self) -> str:
        """How the envelopes are made and what they are used for, in plain words."""
        first = "" if self.high_pass_Hz == "none" else f"high-passed at {self.high_pass_Hz:g} Hz, "
        own = self.normalised_by == "recording"
        by = "their largest values in that file" if own else "given values"
        use = {
            "report": "they are only compared with the activations",
            "target": f"the cost holds {self.weight} (a - e)^2 for each",
            "bounds": f"activations stay within {self.width} of them",
        }[self.use]
        count = sum(map(len, self.channels.values()))
        return (
            f"EMG envelopes of {count} muscles ({self.file.name}: {first}rectified, low-passed at "
            f"{self.cutoff_Hz:g} Hz, over {by}): {use}."
        )
