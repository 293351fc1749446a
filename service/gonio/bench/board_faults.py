"""What the virtual lab says of a calibration: how far it is from the truth, and whether its verdict tells good from spoiled.

The rigs, boards, rates and seeds here are others than those that the verdict's limits were set on.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.bench import Bench
from gonio.bench.board_sessions import VOLUME_LAB_M, Filming, Session, face_on, film, volume_error_mm, write_films
from gonio.errors import CaptureError, InputError, SolverError
from gonio.formats.calibration_json import read_calibration_document
from gonio.formats.toml_calibration import write_toml_calibration
from gonio.kernel.calibration.board_terms import FOCAL
from gonio.kernel.calibration.evidence import KnownLength, gather_evidence
from gonio.kernel.calibration.intrinsics import solve_intrinsics
from gonio.kernel.calibration.rig import RigSolution, solve_rig
from gonio.kernel.calibration.verdict import judge
from gonio.kernel.calibration.volume import expected_error_m
from gonio.kernel.geometry.transforms import apply, inverse
from gonio.pipeline.boards import card_text
from gonio.pipeline.calibration import calibrate
from gonio.pipeline.calibration_files import find_calibration_files
from gonio.pipeline.run import LocalRunner
from gonio.records import Board, Level, Rig

TRUTH_SEEDS = 60
WRONG_BASIN_RAD = np.deg2rad(5.0)

SMALL = Board(name="small 5 × 4", kind="charuco", corners_across=5, corners_down=4, square_m=0.08, marker_m=0.06,
              dictionary="DICT_4X4_50")  # fmt: skip
CHECKERS = Board(name="checkers 8 × 5", kind="checkerboard", corners_across=8, corners_down=5, square_m=0.07)

GOOD: dict[str, Filming] = {
    "paper": Filming(),
    "two_cameras": Filming(cameras=2, radius_m=2.5, poses=400, rate_hz=10.0, board=CHECKERS),
    "three_cameras": Filming(cameras=3, radius_m=2.5, poses=400, rate_hz=10.0, board=SMALL),
    "six_cameras": Filming(cameras=6, radius_m=3.0, poses=400, rate_hz=12.0),
}
SEEDS = (1201, 1202)


@dataclass(frozen=True)
class Case:
    """A session as the verdict sees it: the corners, the optics that were given, and lengths that are known."""

    session: Session
    known: tuple[tuple[int, int], ...] = ()
    """Cameras whose distance was measured by hand."""

    def level(self) -> Level:
        """Calibrate it and give the verdict; an error that says why there is no calibration is a rejection."""
        views, optics = self.session.views, self.session.optics
        try:
            solution = solve_rig(views, optics)
        except (CaptureError, SolverError):
            return "reject"
        evidence = gather_evidence(views, optics, solution, 1 / self.session.filming.rate_hz, self._lengths(solution))
        return judge(evidence).level

    def _lengths(self, solution: RigSolution) -> list[KnownLength]:
        found = [camera.centre_lab_m for camera in solution.lenses(self.session.views)]
        true = [camera.centre_lab_m for camera in self.session.rig.cameras]
        return [
            KnownLength(
                f"{a} to {b}", float(np.linalg.norm(true[a] - true[b])), float(np.linalg.norm(found[a] - found[b]))
            )
            for a, b in self.known
        ]


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong: in the filming, or afterwards."""

    film: Callable[[Filming], Filming] = field(default=lambda filming: filming)
    spoil: Callable[[Session], Session] = field(default=lambda session: session)
    knows_a_length: bool = False


def _wrong_squares(session: Session) -> Session:
    board = session.views.board
    return replace(session, views=replace(session.views, board=replace(board, square_m=1.02 * board.square_m)))


def _other_lens(session: Session) -> Session:
    first, *others = session.optics
    return replace(session, optics=(replace(first, parameters=first.parameters * np.array([1.1, *[1.0] * 8])), *others))


def _untilted_lens(session: Session) -> Session:
    camera, *others = session.optics
    views = face_on(session.rig.cameras[0], session.views.board, 25)
    found = solve_intrinsics(session.views.board, views, camera.image_size_px, camera_name=camera.camera_name)
    return replace(session, optics=(found, *others))


FAULTS: dict[str, Fault] = {
    "square_size": Fault(spoil=_wrong_squares, knows_a_length=True),
    "anisotropic_print": Fault(film=lambda f: replace(f, stretch=0.02)),
    "bump_1deg": Fault(film=lambda f: replace(f, bump_deg=1.0)),
    "two_frames_late": Fault(film=lambda f: replace(f, delay_s=2 / f.rate_hz)),
    "blur": Fault(film=lambda f: replace(f, blur_s=0.03)),
    "noise_1_5px": Fault(film=lambda f: replace(f, noise_px=1.5)),
    "untilted_lens": Fault(spoil=_untilted_lens),
    "blind_camera": Fault(film=lambda f: replace(f, blind_camera=True)),
    "other_lens": Fault(spoil=_other_lens),
    "four_frames": Fault(film=lambda f: replace(f, poses=4)),
}
UNSURE: dict[str, Fault] = {
    # Not always to be seen in the board at all: reported without a bound.
    "bump_0_3deg": Fault(film=lambda f: replace(f, bump_deg=0.3)),
}


def measure_truth(bench: Bench) -> None:
    """Calibrate the paper's rig from 60 boards held still, many times, and compare with the truth."""
    volume_mm, expected_mm, focal_pct, nees, turned_rad = [], [], [], [], []
    for seed in range(TRUTH_SEEDS):
        session = film(seed, Filming(still=True, poses=60))
        solution = solve_rig(session.views, session.optics)
        volume_mm.append(volume_error_mm(solution.lenses(session.views), session.rig))
        grid_ref_m = apply(session.rig.cameras[solution.cameras[0]].T_cam_lab, VOLUME_LAB_M)
        expected_mm.append(1e3 * expected_error_m(solution, grid_ref_m, np.array(session.views.image_sizes_px)))
        true = np.array([camera.intrinsic_px[0, 0] for camera in session.rig.cameras])
        focal_pct.extend(100 * np.abs(solution.scene.theta[:, FOCAL] / true - 1))
        errors = errors_of(solution, session.rig)
        turned_rad.append(np.linalg.norm(errors[:, :3], axis=1).max())
        free = solution.prior.free.ravel()
        C, e = solution.adjusted.covariance[np.ix_(free, free)], errors.ravel()[free]
        nees.append(e @ np.linalg.solve(C, e) / free.sum())
    bench.add("virtual_volume_mm", float(np.median(volume_mm)), "mm", at_most=1.5)
    # What the least squares' covariance says of the same points: no other solution of these corners would do better.
    bench.add("virtual_volume_mm_expected", float(np.median(expected_mm)), "mm")
    bench.add("virtual_volume_mm_p95", np.percentile(volume_mm, 95), "mm")
    bench.add("virtual_focal_pct_median", float(np.median(focal_pct)), "%", at_most=0.2)
    bench.add("virtual_focal_pct_p95", np.percentile(focal_pct, 95), "%")
    bench.add("virtual_wrong_basins", np.sum(np.array(turned_rad) > WRONG_BASIN_RAD), "seeds", at_most=0)
    bench.add("normalised_error_variance", float(np.mean(nees)), "1", at_least=0.8, at_most=1.25)


def errors_of(solution: RigSolution, truth: Rig) -> Float[np.ndarray, "camera 16"]:
    """Give the error of each camera's unknowns, in their order: truth minus found."""
    T_lab_ref = truth.cameras[solution.cameras[0]].T_lab_cam
    errors = np.zeros((len(solution.cameras), 16))
    for place, camera in enumerate(truth.cameras[c] for c in solution.cameras):
        off = camera.T_cam_lab @ T_lab_ref @ inverse(solution.scene.Ts_cam_ref[place])
        K = camera.intrinsic_px
        true = np.array([K[0, 0], K[1, 1] / K[0, 0], K[0, 2], K[1, 2], *camera.distortion, 0.0])
        errors[place] = [
            *Rotation.from_matrix(off[:3, :3]).as_rotvec(),
            *off[:3, 3],
            *(true - solution.scene.theta[place]),
        ]
    return errors


def measure_verdicts(bench: Bench, build_dir: Path) -> None:
    """Count good sessions that are rejected, and spoiled ones that are not.

    ``verdict_false_*`` and ``verdict_cases`` are of all of them but the knock of 0.3°, which a board can't always show.
    """
    good = [Case(film(seed, filming), ((0, 1),)).level() for filming in GOOD.values() for seed in (*SEEDS, 1203, 1204)]
    bench.add("verdict_good_rejected", good.count("reject"), f"of {len(good)}", at_most=0)
    bench.add("verdict_good_accepted_outright", good.count("accept"), f"of {len(good)}")
    spoiled: list[Level] = []
    for name, fault in (FAULTS | UNSURE).items():
        levels: list[Level] = []
        for filming in GOOD.values():
            for seed in SEEDS:
                session = fault.spoil(film(seed, fault.film(filming)))
                levels.append(Case(session, ((0, 1),) if fault.knows_a_length else ()).level())
        missed = sum(level != "reject" for level in levels)
        bench.add(f"verdict_{name}_not_rejected", missed, f"of {len(levels)}", at_most=0 if name in FAULTS else None)
        spoiled += levels if name in FAULTS else []
    good_films, spoiled_films = _measure_films(bench, build_dir)
    good, spoiled = good + good_films, spoiled + spoiled_films
    bench.add("verdict_false_rejects", good.count("reject"), f"of {len(good)}", at_most=0)
    bench.add("verdict_false_accepts", len(spoiled) - spoiled.count("reject"), f"of {len(spoiled)}", at_most=0)
    bench.add("verdict_cases", len(good) + len(spoiled), "sessions")


FILMED = Filming(cameras=3, radius_m=2.5, poses=400, rate_hz=10.0, board=SMALL)
"""Long enough for two halves: a shorter session is rejected for that, whatever else is wrong with it."""
FILMED_FAULTS: dict[str, tuple[Filming, float]] = {
    # The filming, and the blur of the pictures in pixels.
    "anisotropic_print": (replace(FILMED, stretch=0.03), 0.7),
    "bump_1deg": (replace(FILMED, bump_deg=1.0), 0.7),
    "two_frames_late": (replace(FILMED, delay_s=0.2), 0.7),
    "blind_camera": (replace(FILMED, blind_camera=True), 0.7),
    "four_frames": (replace(FILMED, poses=4), 0.7),
}


def _measure_films(bench: Bench, build_dir: Path) -> tuple[list[Level], list[Level]]:
    """The same from rendered films, through the whole river; gives the levels of the good ones and of the spoiled."""
    build_dir.mkdir(parents=True, exist_ok=True)
    good: list[Level] = [level_of_films(seed, FILMED, build_dir) for seed in SEEDS]
    bench.add("films_good_rejected", good.count("reject"), f"of {len(good)}", at_most=0)
    spoiled: dict[str, Level] = {
        name: level_of_films(SEEDS[0], filming, build_dir, blur_px=blur_px)
        for name, (filming, blur_px) in FILMED_FAULTS.items()
    }
    wrong_card = replace(SMALL, corners_across=4, corners_down=5)
    spoiled["wrong_card"] = level_of_films(SEEDS[0], replace(FILMED, poses=30), build_dir, card=wrong_card)
    for name, level in spoiled.items():
        bench.add(f"films_{name}_not_rejected", level != "reject", "of 1", at_most=0)
    return good, list(spoiled.values())


def level_of_films(
    seed: int, filming: Filming, build_dir: Path, *, blur_px: float = 0.7, card: Board | None = None
) -> Level:
    """Render a session's films, calibrate from their files and give the verdict; an error that says why is a rejection."""
    session = film(seed, filming)
    with TemporaryDirectory(dir=build_dir) as name:
        folder = Path(name)
        write_films(session, folder, blur_px=blur_px)
        shown = card or filming.board
        counts = f"{shown.corners_across}x{shown.corners_down}"
        text = card_text(counts, 1000 * shown.square_m, "A0", shown.dictionary, inverted=False)
        (folder / "board.toml").write_text(text, encoding="utf-8")
        lenses = tuple(
            replace(camera, intrinsic_px=optics.intrinsic_px, distortion=optics.distortion)
            for camera, optics in zip(session.rig.cameras, session.optics, strict=True)
        )
        write_toml_calibration(folder / "optics.toml", Rig(cameras=lenses, source=""))
        try:
            result = calibrate(find_calibration_files(folder), {}, LocalRunner(), folder / "gonio")
        except (CaptureError, InputError, SolverError):
            return "reject"
        return read_calibration_document(result.document).verdict.level
