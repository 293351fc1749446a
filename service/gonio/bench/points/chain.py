"""gonio's own way from keypoints to points and motion, as an analysis goes it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gonio.kernel.geometry.transforms import apply
from gonio.pipeline.body import SubjectBody, scale_to_subject
from gonio.pipeline.motion import BodyMotion, fit_motion
from gonio.pipeline.params import KinematicsParameters, Parameters, ReconstructionParameters, Subject
from gonio.pipeline.reconstruction import Reconstruction, hold_lengths, reconstruct, refine_cameras, smooth
from gonio.pipeline.run import CaptureFile
from gonio.records import ImagePoints, LabPoints, Rig


class Points(NamedTuple):
    """The points of a trial, frame by frame (``raw``) and smooth, in a lab that is turned to the subject.

    In ``free`` each keypoint is smooth for itself, in ``smooth`` the segments' lengths are held, unless that was not chosen.
    """

    raw: Reconstruction
    free: LabPoints
    smooth: LabPoints
    refined: Rig  # not turned

    def turned_back(self, points: LabPoints) -> LabPoints:
        """Give points of the turned lab in the calibrated one."""
        turned, before = (rig.cameras[0].T_lab_cam for rig in (self.raw.rig, self.refined))
        T_calibrated_lab = before @ np.linalg.inv(turned)
        rotation = T_calibrated_lab[:3, :3]
        return replace(
            points,
            xyz_lab_m=apply(T_calibrated_lab, points.xyz_lab_m),
            covariance_m2=rotation @ points.covariance_m2 @ rotation.T,
        )


def find_points(points: ImagePoints, rig: Rig, chosen: ReconstructionParameters) -> Points:
    """Refine the cameras, triangulate and smooth; the cameras' clocks are taken for true."""
    refined = refine_cameras(points, rig, chosen).value.rig
    raw = reconstruct(points, refined, chosen).value
    free = smooth(points, raw, chosen).value
    return Points(raw, free, hold_lengths(free, chosen), refined)


def find_motion(
    points: ImagePoints, found: Points, parameters: Parameters, files: Sequence[CaptureFile] = ()
) -> tuple[SubjectBody, BodyMotion]:
    """Scale the body and fit its motion."""
    body = scale_to_subject(found.smooth, parameters.subject, files).value
    return body, fit_motion(body, found.smooth, points, found.raw.rig, parameters).value


def choose(*, min_confidence: float, pixels: bool = True, **reconstruction: object) -> Parameters:
    """Give default parameters, but for the confidence and what is named."""
    method = "pixels" if pixels else "points"
    return Parameters(
        subject=Subject(sex="male"),
        reconstruction=ReconstructionParameters(min_confidence=min_confidence, **reconstruction),  # pyright: ignore[reportArgumentType]
        kinematics=KinematicsParameters(method=method),
    )


def as_marker_set(path: Path) -> CaptureFile:
    """Give a marker set the place that it has in a session."""
    return CaptureFile(path=path, name=path.name, role="marker_set")
