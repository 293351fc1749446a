"""What all classes of the report's schema share."""

from typing import Literal

from pydantic import BaseModel, ConfigDict

Level = Literal["good", "usable", "poor"]
Severity = Literal["info", "warning", "serious"]
Side = Literal["right", "left"]
Series = list[float | None]


class ReportModel(BaseModel):
    """A part of the report; unknown fields are refused, and nothing changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)
