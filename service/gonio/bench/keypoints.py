"""Keypoints: agreement with MediaPipe, what the stage costs beyond the bare network, and memory.

Recording: the demo's (four cameras, 100 frames of 1080 × 1920 each).
"""

import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from gonio.bench import Bench
from gonio.bench.peers import peer_python, run_in_peer
from gonio.demo.recording import ensure_recording
from gonio.errors import GonioError, ResourceError
from gonio.vision.blazepose import LandmarkModel, PersonDetector
from gonio.vision.model_cards import load_card
from gonio.vision.sessions import open_session
from gonio.vision.tracking import PersonTracker
from gonio.vision.video import iterate_frames
from gonio.vision.weights import default_cache_dir, ensure_weights
from gonio.vision.weights.fetch import kept_source

FRAME_STEP = 10
COMPLEXITY = {"blazepose_heavy": 2, "blazepose_full": 1}
"""MediaPipe's number of each network."""

ROUNDS = 3


def run(build_dir: Path) -> dict[str, Any]:
    """Measure all metrics of the bench, and give the content of its JSON file."""
    bench = Bench("keypoints")
    videos = ensure_recording(default_cache_dir()).videos
    try:
        _measure_agreement(bench, build_dir, videos)
    except ResourceError as error:
        bench.leave_out("mediapipe_*", error)
    _measure_speed(bench, videos)
    _measure_memory(bench, build_dir, videos[3])
    return bench.to_json()


def _measure_agreement(bench: Bench, build_dir: Path, videos: Sequence[Path]) -> None:
    """Compare the whole chain, from the file to the landmarks, with MediaPipe's on every tenth frame."""
    python = peer_python(build_dir, "mediapipe", "mediapipe==0.10.21")
    detector, _ = _open_models("blazepose_heavy")
    for name, complexity in COMPLEXITY.items():
        _, landmarks = _open_models(name)
        _give_weights(python, name)
        theirs_path = build_dir.resolve() / "peers" / f"mediapipe_{name}.npz"
        run_in_peer(python, "mediapipe_pose", theirs_path, str(complexity), str(FRAME_STEP), *videos)
        theirs = np.load(theirs_path)
        distances_px = []
        for video in videos:
            for frame in iterate_frames(video):
                if frame.index % FRAME_STEP == 0:
                    # One pass from the detector's region, as MediaPipe does with single pictures.
                    ours_px = landmarks.locate(frame, detector.detect(frame)[0].region).uv_px
                    theirs_px = theirs[video.stem][frame.index // FRAME_STEP]
                    distances_px.append(np.linalg.norm(ours_px - theirs_px, axis=1))
        is_default = name == "blazepose_heavy"
        prefix = "mediapipe" if is_default else "mediapipe_full"
        # Baseline: 1.8 px measured. The network answers half a crop pixel, 2 px, with 2 px.
        bench.add(f"{prefix}_median_px", np.median(distances_px), "px", at_most=2.4 if is_default else None)
        bench.add(f"{prefix}_p95_px", np.percentile(distances_px, 95), "px")


def _give_weights(python: Path, name: str) -> None:
    """Put the weights where MediaPipe looks for them: heavy is not in its wheel, and it would download it."""
    source = load_card(name).sources[0]
    (modules,) = python.parents[1].glob("lib/python*/site-packages/mediapipe/modules/pose_landmark")
    shutil.copyfile(kept_source(default_cache_dir(), source), modules / source.filename)


def _measure_speed(bench: Bench, videos: Sequence[Path]) -> None:
    """Compare following a person through a video with as many calls of the bare network, in turn.

    Both use one thread, and are measured in its processor time: on a quiet machine that is the wall's time, and on a
    shared one it stays what it is.
    """
    card = load_card("blazepose_heavy")
    session = open_session(ensure_weights(card, default_cache_dir()), threads=1)
    detector, _ = _open_models(card.name)
    landmarks = LandmarkModel(card, session)
    image = np.random.default_rng(0).random((1, card.input.size_px, card.input.size_px, 3), dtype=np.float32)
    ratios, bare_ms = [], []
    for video in list(videos) * ROUNDS:
        tracker = PersonTracker(detector, landmarks)
        tracker.start(tracker.candidates(next(iterate_frames(video)))[0])
        start_s = time.process_time()
        calls = sum(tracker.follow(frame) is not None for frame in iterate_frames(video))
        middle_s = time.process_time()
        for _ in range(calls):
            session.run({"image": image})
        bare_s = time.process_time() - middle_s
        ratios.append(bare_s / (middle_s - start_s))
        bare_ms.append(1e3 * bare_s / calls)
    bench.add("stage_vs_raw_session", np.median(ratios), "1")
    bench.add("raw_session_ms", np.median(bare_ms), "ms")
    bench.add("stage_ms", np.median(np.divide(bare_ms, ratios)), "ms")


def _measure_memory(bench: Bench, build_dir: Path, video: Path) -> None:
    """Follow a person through a video and through one ten times as long, each in a process of its own."""
    long_video = build_dir / "bench" / "ten_times.mp4"
    long_video.parent.mkdir(parents=True, exist_ok=True)
    repeat_video(video, long_video, times=10)
    peaks_mb: list[float] = []
    for path, suffix in ((video, "1x"), (long_video, "10x")):
        code = "import sys; from gonio.bench.keypoints import follow_and_tell_memory as f; f(sys.argv[1])"
        done = subprocess.run(  # noqa: S603 - our own code
            [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False
        )
        if done.returncode:
            bench.leave_out("peak_rss_mb_*", GonioError(done.stderr[-300:], hint="Run it alone to see more."))
            return
        peaks_mb.append(float(done.stdout))
        bench.add(f"peak_rss_mb_{suffix}", peaks_mb[-1], "MB")
    # Flat, but for what the allocator happens to keep.
    bench.add("peak_rss_growth", peaks_mb[1] / peaks_mb[0], "1", at_most=1.1)


def follow_and_tell_memory(video: str) -> None:
    """Follow a person through a video and write the peak of this process' memory, in MB, to its output."""
    tracker = PersonTracker(*_open_models("blazepose_heavy"))
    for frame in iterate_frames(Path(video)):
        if tracker.region is None:
            tracker.start(tracker.candidates(frame)[0])
        tracker.follow(frame)
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes here
    sys.stdout.write(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6:.1f}")


def repeat_video(source: Path, target: Path, times: int) -> None:
    """Write a video several times in a row, without coding it anew."""
    with av.open(str(target), "w") as output:
        stream, offset = None, 0
        for _ in range(times):
            with av.open(str(source)) as original:
                pictures = original.streams.video[0]
                stream = stream or output.add_stream_from_template(pictures)
                time_base = pictures.time_base or Fraction(1)
                end = 0
                for packet in original.demux(pictures):
                    if packet.dts is None or packet.pts is None:
                        continue
                    end = max(end, packet.pts + (packet.duration or 1))
                    packet.pts, packet.dts, packet.time_base = packet.pts + offset, packet.dts + offset, time_base
                    packet.stream = stream
                    output.mux(packet)
                offset += end


def _open_models(name: str) -> tuple[PersonDetector, LandmarkModel]:
    cards = load_card("blazepose_detector"), load_card(name)
    sessions = [open_session(ensure_weights(card, default_cache_dir())) for card in cards]
    return PersonDetector(cards[0], sessions[0]), LandmarkModel(cards[1], sessions[1])
