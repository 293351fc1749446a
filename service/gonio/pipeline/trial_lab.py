"""The lab of a trial whose calibration can't tell it, from the subject's own steps: part of stage ``triangulation``."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gonio.errors import CaptureError
from gonio.formats.calibration import read_own_calibration
from gonio.kernel.calibration.lab_frame import lab_from_walker
from gonio.kernel.calibration.walker import find_contacts, upright
from gonio.kernel.geometry.transforms import apply, transform
from gonio.pipeline.finding_kind import counted
from gonio.pipeline.findings import finding
from gonio.pipeline.params import LabChoice
from gonio.pipeline.run import CaptureFile
from gonio.records import Finding, LabPoints, LabSource, Rig

TILTED_DEG = 45.0
"""A walker who is tilted by more in the calibrated lab tells that the lab is not what it should be; a stoop is less."""

OVERTURNED_DEG = 120.0
"""One who only stands or lies must be turned over: lying down is 90°."""

UNSURE_DEG = 1.5
"""A vertical that is known to less is told as a warning: 1.5° are 1.5° in the pelvis' tilt."""


def lab_source(files: Sequence[CaptureFile]) -> LabSource | None:
    """Say what told the session's calibration where the lab is; None for a file of another program, which doesn't say."""
    own = next((read_own_calibration(file.path) for file in files if file.role == "calibration"), None)
    return None if own is None else own.lab.source


def find_trial_lab(
    points: LabPoints, rig: Rig, stride: int, source: LabSource | None, wanted: LabChoice
) -> tuple[LabPoints, Rig, tuple[Finding, ...]]:
    """Give points and cameras in a lab with its floor under the subject's feet, where the calibration's is none.

    Args:
        points: The points in the calibrated lab.
        rig: The cameras there.
        stride: Of so many frames only one was looked at.
        source: What the calibrated lab was taken from.
        wanted: Which lab the request wants; ``auto`` believes the calibration unless it is a guess of its own, or the subject
            walks on a wall.
    """
    if wanted == "calibration":
        return points, rig, ()
    feet = _both_sides(points, stride, ("heel", "ankle"))
    shoulders = _both_sides(points, stride, ("shoulder", "hip"))
    up = (
        None
        if feet is None or shoulders is None
        else upright((feet[0] + feet[1]) / 2, (shoulders[0] + shoulders[1]) / 2)
    )
    if feet is None or up is None:
        return points, rig, ()
    off_deg = float(np.rad2deg(np.arccos(np.clip(up[1], -1, 1))))
    contradicted = off_deg > TILTED_DEG
    if not contradicted and wanted == "auto" and source != "cameras":
        return points, rig, ()
    contacts, is_left = find_contacts(feet[0], feet[1], points.timebase.rate_hz / stride)
    told = (finding("lab-contradicted", value=off_deg),) if contradicted else ()
    try:
        frame = lab_from_walker(contacts, is_left, up)
    except CaptureError:
        if off_deg <= OVERTURNED_DEG:
            return points, rig, (finding("lab-walk-missing"),) if source == "cameras" or wanted == "walker" else ()
        T = transform(Rotation.align_vectors([[0.0, 1.0, 0.0]], [up])[0].as_matrix(), np.zeros(3))
        lowest = np.nanpercentile(np.concatenate([apply(T, foot)[:, 1] for foot in feet]), 5)
        T[1, 3] = -lowest
        return *move_lab(points, rig, T), (*told, finding("lab-from-posture"))
    tilt_deg = float(np.rad2deg(frame.tilt_sd_rad))
    severity = "warning" if tilt_deg > UNSURE_DEG else None
    from_walker = finding(
        "lab-from-walker", where=counted(len(contacts), "step|steps"), value=tilt_deg, severity=severity
    )
    return *move_lab(points, rig, frame.T_lab_ref), (*told, from_walker)


def _both_sides(
    points: LabPoints, stride: int, joints: Sequence[str]
) -> tuple[Float[np.ndarray, "frame 3"], Float[np.ndarray, "frame 3"]] | None:
    """Give the left and right tracks of the first of some joints that the keypoints know, in the frames that were looked at."""
    for joint in joints:
        if {f"left_{joint}", f"right_{joint}"} <= set(points.keypoint_names):
            return points.of(f"left_{joint}")[::stride], points.of(f"right_{joint}")[::stride]
    return None


def move_lab(points: LabPoints, rig: Rig, T_new_old: Float[np.ndarray, "4 4"]) -> tuple[LabPoints, Rig]:
    """Express points and cameras in another lab."""
    rotation = T_new_old[:3, :3]
    moved = replace(
        points,
        xyz_lab_m=apply(T_new_old, points.xyz_lab_m),
        covariance_m2=rotation @ points.covariance_m2 @ rotation.T,
    )
    cameras = tuple(replace(camera, T_lab_cam=T_new_old @ camera.T_lab_cam) for camera in rig.cameras)
    return moved, replace(rig, cameras=cameras)
