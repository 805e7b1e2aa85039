"""The table of what an instrumented implant measured."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from tkamb.scene.table import FORMAT, Number, SceneTable, TableFormat


class MeasuredTable(SceneTable):
    """Axial knee forces of an instrumented implant: held against the run, never used in it."""

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
            raise ValueError("'columns' holds a sum of nothing")
        return self
