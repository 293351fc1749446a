"""A look into a file before it is accepted: what can't be read is refused while its sender is still there."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gonio.errors import InputError
from gonio.jobs.filenames import IMAGES
from gonio.pipeline.run import Role

Probe = Callable[[Path, Role], dict[str, Any]]
"""Opens a file in its role and gives the facts that its owner wants to see (rate, frames, cameras); plain JSON.

Raises a GonioError that names the file and the remedy.
"""


def probe_file(path: Path, role: Role) -> dict[str, Any]:
    """Look into a file with gonio's own readers.

    Raises:
        InputError: ``file-too-nested``, or what the reader says.
    """
    try:
        return _probe(path, role)
    except RecursionError:  # a few kilobytes of brackets do it, in any format that nests
        raise InputError(
            f"The values of {path.name} are nested too deep.",
            hint="Export the file again; no program nests what it means a thousand times.",
            code="file-too-nested",
        ) from None


def _probe(path: Path, role: Role) -> dict[str, Any]:
    # Imported when the first file comes: together they take seconds, and the service answers meanwhile.
    if role in ("joint_tree", "tracks", "background"):
        return _probe_object(path, role)
    if role in ("sweep", "lens", "floor", "picture") and path.suffix.lower() in IMAGES:
        from gonio.vision.stills import read_grey

        height, width = read_grey(path).shape
        return {"width_px": width, "height_px": height}
    if role in ("video", "sweep", "lens", "floor"):
        from gonio.vision.video import probe_video

        info = probe_video(path)
        return {
            "codec": info.codec,
            "width_px": info.image_size_px[0],
            "height_px": info.image_size_px[1],
            "rate_hz": info.rate_hz,
            "frames": info.frame_count,
            "duration_s": info.duration_s,
        }
    if role == "body_model":
        from gonio.formats.osim import read_osim

        model = read_osim(path)
        return {"model": model.name, "bodies": len(model.bodies.names), "mass_kg": round(model.mass_kg, 3)}
    if role == "marker_set":
        from gonio.formats.markerset import read_markerset

        card = read_markerset(path)
        return {"marker_set": card.name, "keypoints": list(card.keypoint_names)}
    if role == "keypoints":
        from gonio.formats.openpose import count_frames, keypoint_count

        return {"frames": count_frames(path), "keypoints": keypoint_count(path)}
    if role in ("pressure", "pressure_card", "force_plates", "force_coefficients"):
        return _probe_forces(path, role)
    if role in ("board", "optics", "floor_points", "previous"):
        return _probe_calibration_input(path, role)
    from gonio.formats.calibration import read_calibration

    return {"cameras": list(read_calibration(path).names)}


def _probe_object(path: Path, role: Role) -> dict[str, Any]:
    from gonio.formats.articulated import Mark, read_body_card
    from gonio.formats.background import BackgroundMark
    from gonio.formats.marks import read_marks

    if role == "joint_tree":
        return {"parts": list(read_body_card(path).parts)}
    marks = read_marks(path, Mark if role == "tracks" else BackgroundMark)
    return {"marks": len(marks), "pictures": sorted({mark.picture for mark in marks})}


def _probe_forces(path: Path, role: Role) -> dict[str, Any]:
    import numpy as np

    from gonio.formats.force_coefficients import read_force_coefficients
    from gonio.formats.force_plates import read_force_plates
    from gonio.formats.pressure_card import read_pressure_card
    from gonio.formats.pressure_csv import has_default_columns, read_pressure

    if role == "pressure_card":
        card = read_pressure_card(path)
        return {"kind": card.kind, "time_column": card.time.column}
    if role == "force_coefficients":
        return {"source": read_force_coefficients(path).source}
    if role == "force_plates":
        plates = read_force_plates(path)
        return {"plates": plates.force_lab_n.shape[1], "samples": len(plates.times_s)}
    if not has_default_columns(
        path
    ):  # only its card, another file, says what it holds: it is read when the analysis begins
        return {"columns": "as its pressure card says"}
    stream = read_pressure(path)
    times_s = stream.pressure.times_s
    return {
        "samples": len(times_s),
        "duration_s": round(float(times_s[-1] - times_s[0]), 3),
        "rate_hz": round(float(1.0 / np.median(np.diff(times_s))), 3),
        "lost": round(float(np.isnan(stream.pressure.vertical_n).mean()), 4),
    }


def _probe_calibration_input(path: Path, role: Role) -> dict[str, Any]:
    from gonio.formats.board_card import read_board_card
    from gonio.formats.calibration import read_intrinsics
    from gonio.formats.calibration_json import read_calibration_document
    from gonio.formats.floor_points import read_floor_points

    if role == "board":
        board = read_board_card(path).board
        corners = [board.corners_across, board.corners_down]
        return {"board": board.name, "inner_corners": corners, "square_mm": round(1e3 * board.square_m, 3)}
    if role == "floor_points":
        return {"points": list(read_floor_points(path, None).names)}
    if role == "previous":
        earlier = read_calibration_document(path)
        return {"cameras": list(earlier.rig.names), "verdict": earlier.verdict.level}
    return {"cameras": [optics.camera_name for optics in read_intrinsics(path)]}
