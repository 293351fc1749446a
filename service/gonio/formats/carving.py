"""What carving found, as JSON: each part's volume, and how well it covers its silhouettes again."""

from pathlib import Path
from typing import Any

from pydantic import Field

from gonio.formats.strict import Strict

FORMAT = "gonio carved parts"


class CarvedPartDocument(Strict):
    """One part."""

    part: str
    volume_m3: float = Field(description="Of all voxels: the most that the part can have, as hollows are never carved.")
    voxel_m: float
    coloured: float = Field(description="Share of the surface's vertices that a picture sees; the others are grey.")
    overlap: dict[str, float] = Field(
        description="For each picture with a mask: what the reprojected surface and the mask have in common of what either "
        "covers, pixels of other parts left out."
    )
    files: list[str]


class CarvingFinding(Strict):
    """What a reader has to know; docs/reference/findings.md explains the code."""

    code: str
    severity: str
    message: str
    hint: str
    where: str
    value: float | None
    unit: str


class CarvingDocument(Strict):
    """All parts that were carved, and the files of the whole body as each picture shows it."""

    format: str = FORMAT
    version: int = 1
    reference: str
    parts: list[CarvedPartDocument]
    bodies: dict[str, list[str]] = Field(description="For each picture: the files of the whole body posed as in it.")
    findings: list[CarvingFinding]


def carving_schema() -> dict[str, Any]:
    """Give the result's JSON schema."""
    return CarvingDocument.model_json_schema()


def write_carving(path: Path, document: CarvingDocument) -> None:
    """Write the result."""
    path.write_text(document.model_dump_json(indent=2) + "\n", encoding="utf-8")
