"""Looking at each camera 30 times a second against every frame at 60: what it saves, and what it costs in millimetres.

Recording: the demo's video. Both modes are whole analyses in processes of their own, of which the processor's seconds are
counted. The reference is what the network says of each frame in the mean of :data:`CROPS` crops that are shifted, scaled and
turned a little, fused over time: it shares the network's bias, so that the differences are noise and lost movement.
"""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.bench import Bench
from gonio.bench.points.chain import choose, find_points
from gonio.demo.recording import Recording, ensure_recording
from gonio.errors import GonioError, ResourceError
from gonio.formats.trc import read_trc
from gonio.kernel.geometry.transforms import align, apply
from gonio.kernel.triangulation.choice import rank_people
from gonio.kernel.triangulation.people import find_people
from gonio.pipeline import analyse
from gonio.pipeline.capture import read_capture, read_rig
from gonio.pipeline.keypoints import DETECTOR, MIN_VISIBILITY
from gonio.pipeline.run import CaptureFile, LocalRunner
from gonio.records import Capture, ImagePoints
from gonio.vision.blazepose import LandmarkModel, PersonDetector, Region
from gonio.vision.model_cards import load_card
from gonio.vision.people import track_people
from gonio.vision.sessions import available_cores, open_session
from gonio.vision.tracking import PersonTracker
from gonio.vision.video import iterate_frames
from gonio.vision.weights import default_cache_dir, ensure_weights

CROPS = 6
SHIFT, SCALE, TURN_RAD = 0.02, 0.03, np.deg2rad(5.0)
"""The largest changes of a crop: as parts of its side, and its angle."""

EDGE_FRAMES = 6
LIMBS = [f"{side}_{joint}" for side in ("left", "right") for joint in
         ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "foot_index")]  # fmt: skip

Track = Float[np.ndarray, "frame keypoint 3"]


def measure_rates(bench: Bench, build_dir: Path) -> None:
    """Measure the ratio of processor seconds and the limbs' median distance from the reference in both modes.

    Raises:
        ResourceError: the recording or the weights can't be had.
    """
    recording = ensure_recording(default_cache_dir())
    seconds: dict[str, float] = {}
    tracks: dict[str, Track] = {}
    names: tuple[str, ...] = ()
    for mode in ("exact", "default"):
        folder = build_dir / "bench" / f"rates_{mode}"
        code = "import sys; from gonio.bench.points.rates import analyse_and_tell_seconds as f; f(*sys.argv[1:])"
        done = subprocess.run(  # noqa: S603 - our own code
            [sys.executable, "-c", code, mode, str(folder)], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise ResourceError(
                f"The analysis in mode {mode} failed: {done.stderr[-300:]}",
                hint="Run `gonio demo` to see more.",
                code="peer-missing",
            )
        seconds[mode] = json.loads(done.stdout.splitlines()[-1])
        found = read_trc(folder / "markers.trc")
        tracks[mode], names = found.xyz_m, found.names
    bench.add("default_mode_cpu_ratio", seconds["exact"] / seconds["default"], "1", at_least=1.5)
    bench.add("default_mode_cpu_s", seconds["default"], "s")
    reference = _find_reference(recording)
    limbs = [names.index(name) for name in LIMBS]
    away: dict[str, float] = {}
    for mode, track in tracks.items():
        error = 1e3 * _distances_m(track, reference)[EDGE_FRAMES:-EDGE_FRAMES, limbs]
        away[mode] = float(np.nanmedian(error))
        bench.add(f"{mode}_mode_mm", away[mode], "mm")
        bench.add(f"{mode}_mode_p95_mm", float(np.nanquantile(error, 0.95)), "mm")
    bench.add("default_mode_extra_mm", away["default"] - away["exact"], "mm", at_most=0.5)


def analyse_and_tell_seconds(mode: str, folder: str) -> None:
    """Analyse the demo's recording; write the processor's seconds of this process to its output.

    A first analysis compiles; what is told is the second one's, as of a worker that runs.
    """
    recording = ensure_recording(default_cache_dir())
    spent = [_cpu_s()]
    for _ in range(2):
        analyse(_files(recording), {"keypoints": {"rate": mode}}, LocalRunner(), Path(folder))
        spent.append(_cpu_s())
    sys.stdout.write(f"\n{spent[2] - spent[1]}")


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _files(recording: Recording) -> list[CaptureFile]:
    videos = [CaptureFile(path=path, name=path.name, role="video") for path in recording.videos]
    calibration = recording.calibration
    return [*videos, CaptureFile(path=calibration, name=calibration.name, role="calibration")]


def _find_reference(recording: Recording) -> Track:
    """Find the reference's tracks, by the chain of an analysis."""
    files = _files(recording)
    capture = read_capture(files, read_rig(files).value).value
    points = _locate_often(capture)
    chosen = choose(min_confidence=0.5)
    return find_points(points, capture.rig, chosen.reconstruction).smooth.xyz_lab_m


def _locate_often(capture: Capture) -> ImagePoints:
    """Follow the subject through every frame, then look again, in several crops around where the tracker looked."""
    cards = load_card(DETECTOR), load_card("blazepose_heavy")
    sessions = [open_session(ensure_weights(card, default_cache_dir())) for card in cards]
    detector, landmarks = PersonDetector(cards[0], sessions[0]), LandmarkModel(cards[1], sessions[1])
    assert cards[1].keypoints is not None  # a landmark card has them: its own check
    names = cards[1].keypoints.names
    workers = available_cores()
    sightings = track_people(capture, detector, landmarks, names, workers=workers, on_progress=lambda _: None)
    tracked = rank_people(capture.rig, find_people(capture.rig, sightings, MIN_VISIBILITY))[0].points
    uv_px, rng = tracked.uv_px.copy(), np.random.default_rng(0)
    confidence = tracked.confidence.copy()
    for camera, view in enumerate(capture.views):
        tracker = PersonTracker(detector, landmarks)
        assert view.path is not None  # the recording is videos
        for frame in iterate_frames(view.path):
            if tracker.region is None:
                people = tracker.candidates(frame)
                subject = min(people, key=lambda p: _apart_px(p.uv_px, tracked.uv_px[camera, frame.index]))
                tracker.start(subject)
            region = tracker.region
            if tracker.follow(frame) is None or region is None:
                continue
            seen = [landmarks.locate(frame, _jittered(region, rng)) for _ in range(CROPS)]
            uv_px[camera, frame.index] = np.median([person.uv_px for person in seen], axis=0)
            confidence[camera, frame.index] = np.median([person.visibility for person in seen], axis=0)
    return ImagePoints(
        camera_names=tracked.camera_names,
        keypoint_names=tracked.keypoint_names,
        timebase=tracked.timebase,
        uv_px=uv_px,
        confidence=np.where(np.isnan(uv_px).any(axis=-1), 0.0, confidence),
    )


def _apart_px(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.nanmedian(np.linalg.norm(one - other, axis=-1)))


def _jittered(region: Region, rng: np.random.Generator) -> Region:
    return Region(
        centre_px=region.centre_px + region.side_px * rng.uniform(-SHIFT, SHIFT, 2),
        side_px=region.side_px * (1 + rng.uniform(-SCALE, SCALE)),
        rotation_rad=region.rotation_rad + rng.uniform(-TURN_RAD, TURN_RAD),
    )


def _distances_m(track: Track, reference: Track) -> Float[np.ndarray, "frame keypoint"]:
    """Give the distances of points whose labs were turned and whose cameras were refined each for itself.

    A rigid motion of all points is of no account to a gait: it is taken out first.
    """
    both = np.isfinite(track[..., 0]) & np.isfinite(reference[..., 0])
    if not both.any():
        raise GonioError("The two ways share no point.", hint="Look at the reports of the two analyses.")
    turned = apply(align(track[both], reference[both]), track)
    return np.linalg.norm(turned - reference, axis=-1)
