"""Stage ``calibration-report``: a calibration written down for gonio, for other programs and for people."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from gonio.formats.calibration import write_calibration_as
from gonio.kernel.calibration.rig import RigSolution
from gonio.kernel.calibration.verdict import CRITERIA
from gonio.kernel.geometry.transforms import apply
from gonio.pipeline.run import ReportFiles
from gonio.records import BoardViews, Calibration, Judgement, Level, RigCheck

FILES = ("calibration.json", "calibration.toml", "calibration.qca.txt", "calibration.yml")

SENTENCES: dict[Level, str] = {
    "accept": "The cameras agree in pictures that were not used: this calibration can be relied on.",
    "warn": "This calibration can be used; read what is uncertain first.",
    "reject": "Don't use this calibration: something serious is wrong with it. What to do stands below.",
}
LABELS: dict[Level, str] = {"accept": "Accepted", "warn": "Accepted with warnings", "reject": "Rejected"}
CSS_CLASSES: dict[Level, str] = {"accept": "good", "warn": "usable", "reject": "poor"}
NAMES = {
    "unconnected": "Connected with the others",
    "halves_missing": "Can be verified",
    "held_out_px": "Miss in unseen pictures",
    "noise_px": "Noise of a corner",
    "camera_bias_px": "Worst camera's offset",
    "length_bias_pct": "Squares' length",
    "anisotropy_pct": "Across against down",
    "halves_baseline_pct": "Distances, half against half",
    "views": "Pictures of the board",
    "common_views": "Pictures in common",
    "tilted_views": "Tilted pictures of the lens",
    "focal_sd_pct": "Focal length, uncertainty",
    "focal_shift": "Focal length, against the given one",
    "delay_ms": "Delay",
    "bump": "Moved while filming",
    "coverage": "Margin reached",
    "second_length_pct": "Second length",
}
"""What each criterion is called in the report."""


def write_calibration_report(
    calibration: Calibration,
    views: BoardViews,
    solution: RigSolution,
    check: RigCheck | None,
    output_dir: Path,
) -> ReportFiles:
    """Write ``calibration.json``, the same for other programs (Pose2Sim, Qualisys, OpenCV), the pictures and the page."""
    from gonio.pipeline.calibration_figures import coverage_figure, plan_figure  # with matplotlib: slow to load

    paths = [output_dir / name for name in FILES]
    for path in paths:
        write_calibration_as(path, calibration)
    corners = [
        apply(calibration.lab.T_lab_ref @ T_ref_board, views.board.corners_board_m)
        for T_ref_board in solution.scene.Ts_ref_board
    ]
    pictures = {
        "plan": plan_figure(calibration.rig, np.concatenate(corners)),
        "coverage": coverage_figure(views, calibration.intrinsics),
    }
    for name, svg in pictures.items():
        paths.append(output_dir / f"{name}.svg")
        paths[-1].write_text(svg, encoding="utf-8")
    page = output_dir / "calibration.html"
    page.write_text(render(calibration, check, pictures), encoding="utf-8")
    return ReportFiles(document=paths[0], page=page, others=tuple(paths[1:]))


def render(calibration: Calibration, check: RigCheck | None, pictures: Mapping[str, str]) -> str:
    """Render the calibration as one self-contained page; the worst findings come first. ``pictures`` are SVG texts."""
    order = {"serious": 0, "warning": 1, "info": 2}
    environment = Environment(
        loader=PackageLoader("gonio.pipeline", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("calibration.html.jinja").render(
        calibration=calibration,
        level=CSS_CLASSES[calibration.verdict.level],
        label=LABELS[calibration.verdict.level],
        sentence=SENTENCES[calibration.verdict.level],
        findings=sorted(calibration.findings, key=lambda f: order[f.severity]),
        check=[] if check is None else check_rows(check),
        criteria=[criterion_row(judgement) for judgement in calibration.verdict.judgements],
        cameras=[camera_row(calibration, index) for index in range(len(calibration.rig.cameras))],
        plan_svg=pictures["plan"],
        coverage_svg=pictures["coverage"],
    )


def criterion_row(judgement: Judgement) -> dict[str, str]:
    """Describe a judgement in the words of the report."""
    criterion = CRITERIA[judgement.name]
    sign = "≥" if criterion.at_least else "≤"
    return {
        "name": NAMES[judgement.name],
        "where": judgement.where,
        "value": f"{judgement.value:.3g} {criterion.unit}".strip(),
        "accept": f"{sign} {judgement.accept:.3g}",
        "warn": f"{sign} {judgement.warn:.3g}",
        "css": CSS_CLASSES[judgement.level],
        "level": judgement.level,
        "reason": criterion.reason,
    }


def check_rows(check: RigCheck) -> list[dict[str, str]]:
    """Describe how the earlier calibration fits, a row a camera."""
    return [
        {
            "name": name,
            "off": f"{check.shift_px[camera]:.2f} ± {check.shift_sd_px[camera]:.2f} px",
            "turned": f"{np.rad2deg(check.turned_rad[camera]):.2f} ± {np.rad2deg(check.turned_sd_rad[camera]):.2f}°",
            "shifted": f"{1000 * check.shifted_m[camera]:.0f} ± {1000 * check.shifted_sd_m[camera]:.0f} mm",
            "css": "poor" if check.moved[camera] else "good",
            "state": "has moved" if check.moved[camera] else "stands as it stood",
        }
        for camera, name in enumerate(check.camera_names)
    ]


def camera_row(calibration: Calibration, index: int) -> dict[str, str]:
    """Describe a camera in the words of the report."""
    camera, optics = calibration.rig.cameras[index], calibration.intrinsics[index]
    focal_sd_px = float(np.sqrt(calibration.covariance[16 * index + 6, 16 * index + 6]))
    delay_ms, delay_sd_ms = 1e3 * float(calibration.delay_s[index]), 1e3 * float(calibration.delay_sd_s[index])
    return {
        "name": camera.name,
        "focal": f"{camera.intrinsic_px[0, 0]:.1f} ± {focal_sd_px:.1f} px",
        "lens": f"{optics.model}, from {'this recording' if optics.origin == 'session' else 'a ' + optics.origin}",
        "held_out": f"{optics.held_out_px:.2f} px" if np.isfinite(optics.held_out_px) else "–",
        "place": ", ".join(f"{x:.3f}" for x in camera.centre_lab_m) + " m",
        "delay": "the clock" if index == 0 else f"{delay_ms:+.1f} ± {delay_sd_ms:.1f} ms",
    }


def calibration_key_lines(calibration: Calibration) -> list[str]:
    """Give the lines of a calibration that matter most, for a terminal."""
    volume = calibration.volume
    size = volume.upper_lab_m - volume.lower_lab_m
    late = ", ".join(
        f"{camera.name} {1e3 * delay:+.0f}"
        for camera, delay in zip(calibration.rig.cameras[1:], calibration.delay_s[1:], strict=True)
    )
    held_out = {j.name: j.value for j in calibration.verdict.judgements}
    lines = [f"{LABELS[calibration.verdict.level]}. {SENTENCES[calibration.verdict.level]}"]
    if "held_out_px" in held_out:
        lines.append(
            f"In unseen pictures: {held_out['held_out_px']:.2f} px median, squares {held_out['length_bias_pct']:.2f} % off, "
            f"distances of the cameras within {held_out['halves_baseline_pct']:.2f} %"
        )
    lines += [
        f"Volume: {size[0]:.1f} × {size[1]:.1f} × {size[2]:.1f} m, expected error {1e3 * volume.error_m:.1f} mm",
        f"Delays against {calibration.rig.cameras[0].name}, ms: {late}",
    ]
    return lines
