"""A session of kind ``articulated_object``: joint tree, tracks, and what tells the cameras in; the motion and a page out."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from gonio.errors import CaptureError, InputError
from gonio.formats.articulated import ArticulatedDocument, read_body_card, write_motion
from gonio.pipeline.articulated import articulated_lines, locate, solve_photographed
from gonio.pipeline.run import CaptureFile, Outcome, Progress, ReportFiles, StageRunner

OBJECT_SHARES: Mapping[str, float] = MappingProxyType({"object": 1.0})


def analyse_object(
    capture_files: Sequence[CaptureFile], parameters: Mapping[str, Any], runner: StageRunner, output_dir: Path
) -> ReportFiles:
    """Find cameras and joints, and write ``report.json`` (docs/reference/articulated.schema.json) and ``report.html``.

    Raises:
        InputError: A file is wrong, or a parameter was given: there is none.
        CaptureError: The cameras or no joint's motion can be told from these pictures; the code says why.
    """
    unknown = sorted(set(parameters) - {"subject"})
    if unknown:
        raise InputError(
            f"An articulated object has no parameter {unknown[0]}.", hint="Leave it out.", code="parameter-unknown"
        )

    def solve(progress: Progress) -> Outcome[str]:
        document = _solve(capture_files, progress)
        return Outcome(document.model_dump_json())

    document = ArticulatedDocument.model_validate_json(runner("object", solve))
    motion, page = output_dir / "report.json", output_dir / "report.html"
    write_motion(motion, document)
    page.write_text(render_object(document), encoding="utf-8")
    return ReportFiles(document=motion, page=page)


def _solve(files: Sequence[CaptureFile], progress: Progress) -> ArticulatedDocument:
    by_role = {file.role: file.path for file in files if file.role != "picture"}
    pictures = {file.camera or PurePath(file.name).stem: file.path for file in files if file.role == "picture"}
    card, tracks = read_body_card(by_role["joint_tree"]), by_role["tracks"]
    photographs = locate(
        card, by_role.get("calibration"), by_role.get("background"), dict(sorted(pictures.items())), tracks
    )
    progress(0.5)
    document = solve_photographed(card, photographs, tracks)
    if not document.joints:
        first = document.refused[0]
        raise CaptureError(first.message, hint=first.hint, code=first.code)
    return document


def render_object(document: ArticulatedDocument) -> str:
    """Render the motion as one self-contained page."""
    environment = Environment(
        loader=PackageLoader("gonio.pipeline", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("articulated.html.jinja").render(
        document=document, lines=articulated_lines(document)
    )
