"""The river after the network, on a body whose angles are known: keypoints in, report out, all of it real."""

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from lxml import html

from gonio.formats.force_coefficients import builtin_force_coefficients
from gonio.formats.mot import read_mot
from gonio.formats.osim import read_osim
from gonio.formats.trc import read_trc
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.markerset import attach
from gonio.kernel.body.scaling import scale_model
from gonio.kernel.geometry.cameras import project
from gonio.pipeline import report as report_module
from gonio.pipeline.body import choose_markerset, scale_to_subject
from gonio.pipeline.describe import Analysis
from gonio.pipeline.gait import analyse_gait
from gonio.pipeline.keypoints import Keypoints
from gonio.pipeline.motion import fit_motion
from gonio.pipeline.params import Parameters, Subject
from gonio.pipeline.pressure import Measured
from gonio.pipeline.reconstruction import hold_lengths, reconstruct, refine_cameras, smooth, synchronize
from gonio.pipeline.report import key_lines, load_report, write_report
from gonio.pipeline.report_schema import report_schema
from gonio.pipeline.run import CaptureFile, LocalRunner
from gonio.records import BodyModel, Capture, ImagePoints, Rig, Timebase, View
from gonio.resources import models_dir
from gonio.vision.model_cards import load_card
from gonio.vision.pictures import encode_jpeg

RATE_HZ, FRAMES = 60.0, 120


def walker() -> BodyModel:
    """The built-in body, 5 % larger than its table."""
    card = load_card("blazepose_heavy").keypoints
    assert card is not None
    generic = read_osim(models_dir() / "bodies" / "fullbody_male.osim")
    model = attach(generic, choose_markerset(generic, card.names))
    return scale_model(model, np.full((len(model.bodies.names), 3), 1.05), mass_kg=72.6)


def gait(model: BodyModel) -> np.ndarray:
    """Two seconds of a smooth walk towards +X: the curves are a few harmonics of a 1 Hz stride."""
    t = np.arange(FRAMES) / RATE_HZ
    q = np.tile(model.coordinates.default, (FRAMES, 1))

    def put(name: str, values: np.ndarray) -> None:
        q[:, model.coordinates.index(name)] = values

    put("pelvis_tx", -1.2 + 1.2 * t)
    put("pelvis_ty", 0.98 + 0.02 * np.cos(4 * np.pi * t))
    for side, phase in (("r", 0.0), ("l", np.pi)):
        wave = 2 * np.pi * t + phase
        put(f"hip_flexion_{side}", np.deg2rad(10 + 20 * np.cos(wave)))
        put(f"knee_angle_{side}", np.deg2rad(30 - 25 * np.cos(wave - 0.9)))
        put(f"ankle_angle_{side}", np.deg2rad(8 * np.sin(wave)))
    return q


def film(rig: Rig, xyz: np.ndarray, names: tuple[str, ...], noise_px: float) -> ImagePoints:
    rng = np.random.default_rng(20)
    uv = np.stack([project(camera, xyz) for camera in rig.cameras])
    uv += rng.normal(0, noise_px, uv.shape)
    confidence = rng.uniform(0.7, 1.0, uv.shape[:3])
    hidden = rng.random(uv.shape[:3]) < 0.05
    uv[hidden], confidence[hidden] = np.nan, 0.0
    return ImagePoints(
        camera_names=rig.names,
        keypoint_names=names,
        timebase=Timebase(rate_hz=RATE_HZ),
        uv_px=uv,
        confidence=confidence,
    )


NOTHING = Measured(pressure=None, clock=None, plates=None)
"""No soles, no plates."""


@pytest.fixture
def analysis(rig: Rig, tmp_path: Path) -> Analysis:
    model = walker()
    points = film(rig, marker_positions(model, gait(model)), model.markers.names, noise_px=2.0)
    chosen = Parameters(subject=Subject(mass_kg=72.6, sex="male"))
    runner = LocalRunner()
    delays, points = runner("synchronization", lambda _: synchronize(points, rig, chosen.reconstruction))
    refined = runner("cameras", lambda _: refine_cameras(points, rig, chosen.reconstruction))
    raw = runner("triangulation", lambda _: reconstruct(points, refined.rig, chosen.reconstruction))
    tracks = runner("smoothing", lambda _: smooth(points, raw, chosen.reconstruction))
    smoothed = hold_lengths(tracks, chosen.reconstruction)
    body = runner("scaling", lambda _: scale_to_subject(smoothed, chosen.subject))
    motion = runner("kinematics", lambda _: fit_motion(body, smoothed, points, raw.rig, chosen))
    cycles = runner("gait", lambda _: analyse_gait(motion, smoothed.timebase, NOTHING))
    pictures = []
    for name in rig.names:
        path = tmp_path / f"{name}.jpg"
        path.write_bytes(encode_jpeg(np.full((360, 640, 3), 128, np.uint8)))
        pictures.append(path)
    views = tuple(
        View(
            camera_name=name,
            file_name=f"{name}.mp4",
            path=path,
            image_size_px=(1280, 720),
            rate_hz=RATE_HZ,
            frame_count=FRAMES,
        )
        for name, path in zip(rig.names, pictures, strict=True)
    )
    return Analysis(
        files=tuple(CaptureFile(path=p, name=p.name, role="video") for p in pictures),
        parameters=chosen,
        capture=Capture(rig=rig, views=views, timebase=Timebase(rate_hz=RATE_HZ), frame_count=FRAMES),
        keypoints=Keypoints(
            networks=("blazepose_detector", "blazepose_heavy"),
            points=points,
            pictures=tuple(pictures),
            picture_frame=60,
            picture_scale=(0.5,) * len(pictures),
        ),
        synchronization=delays,
        refinement=refined,
        raw=raw,
        tracks=tracks,
        points=smoothed,
        body=body,
        motion=motion,
        measured=NOTHING,
        coefficients=builtin_force_coefficients(),
        forces=None,
        torques=None,
        gait=cycles,
    )


def test_the_angles_are_those_of_the_walker(analysis: Analysis) -> None:
    model = walker()
    truth = gait(model)
    inner = slice(10, -10)  # filters know less at the ends
    for name in ("hip_flexion_r", "knee_angle_r", "ankle_angle_r", "hip_flexion_l", "knee_angle_l", "ankle_angle_l"):
        error = np.rad2deg(analysis.motion.motion.of(name) - truth[:, model.coordinates.index(name)])[inner]
        # 2 px are 10 mm at 5 m; three or four cameras, the median and 6 of 30 Hz leave some 3 mm a point. Across a shank
        # of 0.4 m two such points are 0.6°; the ankle has a foot of 0.2 m: 1.5°. Twice that for the walker's pelvis tilt.
        assert np.sqrt(np.mean(error**2)) < (3.0 if "ankle" in name or "hip" in name else 1.5), name
    assert np.nanmean(analysis.motion.motion.residual_rms_m) < 0.012
    assert analysis.body.scales[model.bodies.index("tibia_r"), 1] == pytest.approx(1.05, abs=0.01)


def test_the_report_is_written_for_people_programs_and_opensim(
    analysis: Analysis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = tmp_path / "weights.onnx"
    weights.write_bytes(b"weights")
    monkeypatch.setattr(report_module, "ensure_weights", lambda *_args, **_named: weights)  # hashed, not run
    written = write_report(analysis, (), tmp_path)
    document = json.loads(written.document.read_text())
    jsonschema.validate(document, report_schema())
    assert document["verdict"]["level"] == "good"
    assert document["schema_version"] == "1.4"
    assert [s["name"] for s in document["reconstruction"]["segments"]][:2] == ["right thigh", "left thigh"]
    assert load_report(written.document).model_dump(mode="json") == document
    assert len(key_lines(load_report(written.document))) == 6
    page = html.document_fromstring(written.page.read_text())
    assert page.xpath("//img[starts-with(@src, 'data:image/jpeg')]")
    assert page.xpath("//svg[@role='img'] | //*[local-name()='svg'][@role='img']")
    # Self-contained: nothing is fetched from anywhere.
    assert not page.xpath("//script | //link | //img[not(starts-with(@src, 'data:'))]")
    trc, mot = (read_trc(written.others[0]), read_mot(written.others[1]))
    np.testing.assert_allclose(trc.xyz_m, analysis.points.xyz_lab_m, atol=1e-5)
    assert mot.labels == analysis.motion.motion.coordinate_names


def test_a_result_without_a_single_solved_frame_is_still_a_report(
    analysis: Analysis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = tmp_path / "weights.onnx"
    weights.write_bytes(b"weights")
    monkeypatch.setattr(report_module, "ensure_weights", lambda *_args, **_named: weights)
    blind = replace(analysis.points, xyz_lab_m=np.full_like(analysis.points.xyz_lab_m, np.nan))
    motion = fit_motion(analysis.body, blind, analysis.keypoints.points, analysis.raw.rig, analysis.parameters)
    assert [f.code for f in motion.findings] == ["frames-unsolved"]
    cycles = analyse_gait(motion.value, blind.timebase, NOTHING)
    assert [f.code for f in cycles.findings] == ["gait-no-cycle"]
    blinded = replace(analysis, points=blind, motion=motion.value, gait=cycles.value)
    written = write_report(blinded, motion.findings, tmp_path)
    document = json.loads(written.document.read_text())
    jsonschema.validate(document, report_schema())
    assert document["verdict"]["level"] == "poor"
    assert document["angles"][0]["min_deg"] is None
