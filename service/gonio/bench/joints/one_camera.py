"""Virtual walkers filmed by one camera: how far the joint angles are from the truth, from the side, at 45° and from the front.

Each walker's thighs, shanks and feet differ from the model's by 3 % (one standard deviation, each its own), and only the
stature is known; 60 Hz (each picture is looked at), 2.9 s, a camera of 1280 × 720 at 5 m. First with 2 px of noise that is new
in every picture, which the fit is told. Then (``_real``) with the errors of a real detector, as measured on a recording,
most of which last for a while; that is what the fit believes of keypoints unless it is told better.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.points.chain import choose, find_motion, find_points
from gonio.bench.realism import read_balancing
from gonio.demo.virtual import true_motion
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.scaling import scale_model
from gonio.kernel.geometry.transforms import transform
from gonio.kernel.kinematics.clinical import clinical_deg, clinical_sd_deg, find_clinical_angles
from gonio.kernel.kinematics.monocular import Scatter
from gonio.kernel.virtual_lab import film, grow, walk
from gonio.kernel.virtual_lab.effects import Detector, Effects
from gonio.pipeline.monocular import fit_view, scale_to_stature
from gonio.pipeline.params import FOREIGN_CONFIDENCE, KeypointParameters, Parameters, Subject
from gonio.records import BodyModel, Camera, Motion, Rig, VirtualTrial
from gonio.resources import models_dir

WALKERS, FIRST_SEED = 12, 100
VIEWS_DEG = {"side": 0.0, "oblique": 45.0, "frontal": 90.0}
DISTANCE_M, FOCAL_PX, NOISE_PX = 5.0, 900.0, 2.0
RATE_HZ, DURATION_S = 60.0, 2.9
LENGTH_SD = 0.03
STATURE_M = {"female": (1.63, 0.07), "male": (1.77, 0.07)}
SEGMENTS = (
    ("femur_r", "femur_l"),
    ("tibia_r", "tibia_l"),
    ("talus_r", "calcn_r", "toes_r", "talus_l", "calcn_l", "toes_l"),
)
TOES_REST_M = 0.02
"""How high the toes' keypoint is when the foot stands."""

IDEAL = Detector(
    sigma_m=NOISE_PX * DISTANCE_M / FOCAL_PX,
    white=1.0,
    bias_m=0.0,
    confidence=0.9,
    foot_confidence=0.9,
    confidence_sd=0.0,
)
MEASURED_RMS_DEG = 5.0
"""An error above this must be marked."""


class Score(NamedTuple):
    """One walker from one side: errors and bands over time, and which knees the report would mark."""

    error_deg: Float[np.ndarray, "knee frame"]
    sd_deg: Float[np.ndarray, "knee frame"]
    depth_error_m: Float[np.ndarray, " frame"]
    marked: tuple[bool, bool]
    converged: bool


def measure_walkers(bench: Bench) -> None:
    """Add the metrics of the virtual walkers."""
    bench.explain(__doc__)
    views = {
        name: [measure(FIRST_SEED + number, view_deg) for number in range(WALKERS)]
        for name, view_deg in VIEWS_DEG.items()
    }
    for name, scores in views.items():
        summarise(bench, name, scores)
    covered = 100 * _covered([score for scores in views.values() for score in scores])
    bench.add("human_coverage95_pct", covered, "%", at_least=90, at_most=98)
    for name, view_deg in VIEWS_DEG.items():
        real = [measure(FIRST_SEED + number, view_deg, Detector()) for number in range(WALKERS)]
        bench.add(f"human_knee_deg_{name}_real", _rms_deg(real), "deg")
        bench.add(f"human_depth_m_{name}_real", _depth_rms_m(real), "m")
        bench.add(f"human_coverage95_pct_{name}_real", 100 * _covered(real), "%", at_least=90)
        marked = np.array([s.marked for s in real])
        bench.add(f"human_marked_pct_{name}_real", 100 * float(marked.mean()), "%")


def measure_balancing(bench: Bench) -> None:
    """Compare each camera of the balancing trial, alone, with all four: the knees' flexion over time.

    The person's stature was not written down: it is taken from the leg's length by four cameras. The person stands on
    a beam: its upper side is made the floor, as the findings advise, by the left foot's toes, which stay on it.

    Raises:
        ResourceError: the recording is not there.
    """
    rig, points = read_balancing()
    chosen = choose(min_confidence=FOREIGN_CONFIDENCE)
    found = find_points(points, rig, chosen.reconstruction)
    body, four = find_motion(points, found, chosen)
    toes_m = float(np.nanmedian(found.smooth.of("left_big_toe")[:, 1]))
    rig = _with_floor_at(rig, toes_m - TOES_REST_M)
    generic = read_osim(body.file)
    leg = [body.model.bodies.index(name) for name in ("femur_r", "tibia_r")]
    subject = Subject(sex="male", stature_m=_stature_m(generic) * float(body.scales[leg, 1].mean()))
    angles = [a for a in find_clinical_angles(four.model) if a.name == "knee_flexion"]
    for number, camera in enumerate(rig.cameras):
        own = replace(
            points,
            camera_names=(camera.name,),
            uv_px=points.uv_px[number : number + 1],
            confidence=points.confidence[number : number + 1],
        )
        alone = Rig(cameras=(camera,), source=rig.source)
        asked = replace(chosen, subject=subject)
        outcome = fit_view(scale_to_stature(own, subject).value, own, alone, asked)
        alone_motion = outcome.value.motion.motion
        apart = np.stack([clinical_deg(alone_motion, a) - clinical_deg(four.motion, a) for a in angles])
        band = 1.96 * np.stack([clinical_sd_deg(alone_motion, a) for a in angles])
        known = np.isfinite(apart)
        within = 100 * float((np.abs(apart) < band)[known].mean()) if known.any() else np.nan
        marked = sum(f.code == "view-unreliable" and "knee" in f.where for f in outcome.findings)
        bench.add(f"human_balancing_{camera.name}_view_deg", float(np.degrees(outcome.value.view_rad)), "deg")
        bench.add(f"human_balancing_{camera.name}_knee_rms_deg", float(np.sqrt(np.nanmean(apart**2))), "deg")
        bench.add(f"human_balancing_{camera.name}_within_band_pct", within, "%")
        bench.add(f"human_balancing_{camera.name}_knees_marked", marked, "of 2")


def _with_floor_at(rig: Rig, height_m: float) -> Rig:
    """Give the rig in a lab whose floor is that much higher."""
    down = transform(np.eye(3), np.array([0.0, -height_m, 0.0]))
    return replace(rig, cameras=tuple(replace(camera, T_lab_cam=down @ camera.T_lab_cam) for camera in rig.cameras))


def summarise(bench: Bench, view: str, scores: list[Score]) -> None:
    """Put one view's scores into the bench."""
    rms = np.sqrt(np.nanmean(np.stack([s.error_deg for s in scores]) ** 2, axis=2))
    goal = {"side": 2.5, "oblique": 3.5}.get(view)
    bench.add(f"human_knee_deg_{view}", _rms_deg(scores), "deg", at_most=goal)
    bench.add(f"human_knee_deg_{view}_median", float(np.median(rms)), "deg")
    bench.add(f"human_knee_deg_{view}_worst", float(rms.max()), "deg")
    bench.add(f"human_depth_m_{view}", _depth_rms_m(scores), "m")
    bench.add(f"human_coverage95_pct_{view}", 100 * _covered(scores), "%", at_least=90, at_most=98)
    marked = np.array([s.marked for s in scores])
    bench.add(f"human_marked_pct_{view}", 100 * float(marked.mean()), "%")
    bench.add(f"human_large_unmarked_{view}", int((~marked & (rms > MEASURED_RMS_DEG)).sum()), "knees", at_most=0)
    bench.add(f"human_converged_pct_{view}", 100 * float(np.mean([s.converged for s in scores])), "%")


def _rms_deg(scores: list[Score]) -> float:
    return float(np.sqrt(np.mean(np.nanmean(np.stack([s.error_deg for s in scores]) ** 2, axis=2))))


def _depth_rms_m(scores: list[Score]) -> float:
    return float(np.sqrt(np.mean([np.nanmean(s.depth_error_m**2) for s in scores])))


def _covered(scores: list[Score]) -> float:
    """Give the share of the knees' errors that lies in the 95 % band."""
    error, sd = np.stack([s.error_deg for s in scores]), np.stack([s.sd_deg for s in scores])
    return float((np.abs(error) < 1.96 * sd)[np.isfinite(error)].mean())


def measure(seed: int, view_deg: float, detector: Detector = IDEAL) -> Score:
    """Film a walker from one side and fit the body to what was seen, believing of the detector what is true."""
    trial, subject = film_walker(seed, view_deg, detector)
    body = scale_to_stature(trial.points, subject).value
    asked = Parameters(subject=subject, keypoints=KeypointParameters(rate="exact"))
    scatter = Scatter(detector.sigma_m * detector.confidence, detector.white, detector.correlation_s)
    outcome = fit_view(body, trial.points, trial.rig, asked, scatter=scatter)
    motion, truth = outcome.value.motion, true_motion(trial)
    angles = [a for a in find_clinical_angles(motion.model) if a.name == "knee_flexion"]
    marked = {found.where for found in outcome.findings if found.code == "view-unreliable"}
    first, second = (f"{angle.side} knee flexion" in marked for angle in angles)
    assert motion.fit is not None
    # The fit turns the lab so that the subject faces +X; the distance along the line of sight is the same in both.
    found_m = _depth_m(motion.motion, outcome.value.rig.cameras[0])
    return Score(
        error_deg=np.stack([clinical_deg(motion.motion, a) - clinical_deg(truth, a) for a in angles]),
        sd_deg=np.stack([clinical_sd_deg(motion.motion, a) for a in angles]),
        depth_error_m=found_m - _depth_m(truth, trial.rig.cameras[0]),
        marked=(first, second),
        converged=motion.fit.converged,
    )


def _depth_m(motion: Motion, camera: Camera) -> Float[np.ndarray, " frame"]:
    """Give the pelvis's distance along the optical axis."""
    place = np.stack([motion.of(name) for name in ("pelvis_tx", "pelvis_ty", "pelvis_tz")], axis=1)
    return (place - camera.centre_lab_m) @ camera.T_lab_cam[:3, 2]


def film_walker(seed: int, view_deg: float, detector: Detector = IDEAL) -> tuple[VirtualTrial, Subject]:
    """Film a walker; the same seed is the same walker in every view."""
    rng = np.random.default_rng(seed)
    sex = ("female", "male")[seed % 2]
    mean, sd = STATURE_M[sex]
    body = grow(
        read_osim(models_dir() / "bodies" / f"fullbody_{sex}.osim"),
        stature_m=float(np.clip(rng.normal(mean, sd), mean - 2 * sd, mean + 2 * sd)),
        mass_kg=70.0,
    )
    factors = np.ones((len(body.bodies.names), 3))
    for segments in SEGMENTS:
        factors[[body.bodies.index(name) for name in segments]] = np.exp(LENGTH_SD * rng.standard_normal())
    body = scale_model(body, factors)
    speed_m_s = float(rng.uniform(0.8, 1.6))
    trial = film(
        walk(body, speed_m_s, start_m=-0.5 * DURATION_S * speed_m_s),
        Rig(cameras=(camera_at(view_deg),), source="virtual camera"),
        read_markerset(models_dir() / "markersets" / "blazepose33.toml"),
        effects=Effects(detector=detector),
        rate_hz=RATE_HZ,
        duration_s=DURATION_S,
        seed=seed,
    )
    subject: Any = {"sex": sex, "stature_m": _stature_m(body), "mass_kg": 70.0}
    return trial, Subject(**subject)


def camera_at(view_deg: float) -> Camera:
    """Put a camera beside the middle of the way, 1.2 m high: 0° is from the right side, 90° from the front."""
    angle = np.deg2rad(view_deg)
    centre = np.array([DISTANCE_M * np.sin(angle), 1.2, DISTANCE_M * np.cos(angle)])
    forward = np.array([0.0, 0.9, 0.0]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return Camera(
        name="camera",
        image_size_px=(1280, 720),
        intrinsic_px=np.array([[FOCAL_PX, 0.0, 639.5], [0.0, FOCAL_PX, 359.5], [0.0, 0.0, 1.0]]),
        distortion=np.zeros(5),
        T_lab_cam=transform(np.stack([right, np.cross(forward, right), forward], axis=1), centre),
    )


def _stature_m(body: BodyModel) -> float:
    place = marker_positions(body, body.coordinates.default[None])[0]
    return float(place[body.markers.index("vertex"), 1] - place[body.markers.index("heel_r"), 1])
