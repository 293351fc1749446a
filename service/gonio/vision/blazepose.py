"""BlazePose: find people in a picture, then 33 landmarks of each in a crop that is turned upright.

This follows MediaPipe's graph ``pose_landmark_cpu`` (version 0.10.21) step by step, because the networks were trained
for exactly these steps; each function names the calculator that it stands for.

Half pixels
-----------
Everywhere in gonio (0, 0) is the **centre** of the top-left pixel. MediaPipe's coordinates are fractions of the
picture's width, which ought to mean that the centre of pixel ``i`` lies at ``i + 0.5``. But its CPU path hands them to
OpenCV's warp as they are, and OpenCV counts from the centres. So pixel ``i`` of a crop of ``n`` pixels is sampled at

    centre + rotation @ (i - n / 2) * side / n

in pixel-centre coordinates of the frame, and a landmark at ``l`` in the crop is put back by the same formula: what
MediaPipe reports, times the width, *is* a pixel-centre coordinate. gonio does the same, to the fraction of a pixel: the
network is so sensitive that a crop moved by half a crop pixel gives landmarks 2.3 px away in the median.

A small bias stays. In a mirrored crop of 256 pixels, pixel ``i`` becomes ``255 - i``, but the network's refined
landmarks become ``256 - l`` (255.97 in the mean of 2212): it counts from the edge, so that all points lie half a crop
pixel, 2 px of a 1080 × 1920 frame, to the right and below. That shifts the skeleton as a whole and bends no joint, and
taking it away changes the reprojection error in held-out frames by 0.01 px; so agreement with MediaPipe was preferred.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32
from scipy.special import expit

from gonio.records import record
from gonio.vision.frame import Frame
from gonio.vision.model_cards import Detection, ModelCard, Refinement
from gonio.vision.sessions import InferenceSession

REGION_SCALE = 1.25
"""How much wider than the body's circle a crop is. Never more, "to be safe": 1.1 times this costs 2 px, 1.4 times 8."""

VALUES_PER_POINT = 5  # x, y, z, visibility, presence


@record
class Region:
    """A turned square of the picture: where the landmark network looks.

    ``rotation_rad`` is clockwise as seen in the picture: the crop's "up" points to ``(sin, −cos)`` in the picture.
    """

    centre_px: Float[np.ndarray, "2"]
    side_px: float
    rotation_rad: float

    def T_frame_crop(self, size_px: int) -> Float[np.ndarray, "3 3"]:
        """Map the pixels of a crop of ``size_px`` to the frame's; see "Half pixels" above."""
        scale = self.side_px / size_px
        cos, sin = scale * np.cos(self.rotation_rad), scale * np.sin(self.rotation_rad)
        T = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        T[:2, 2] = self.centre_px - T[:2, :2] @ np.full(2, size_px / 2)
        return T


@record
class DetectedPerson:
    """A person that the detector found: how sure it is (0 to 1), and where to look for the landmarks."""

    score: float
    region: Region


@record
class PersonLandmarks:
    """The landmarks of one person in one frame.

    ``visibility`` is the network's probability that a point is in the picture and not hidden, ``presence`` that there
    is a person at all. ``region`` is the crop that was used, ``next_region`` the one that these landmarks ask for.
    """

    uv_px: Float[np.ndarray, "keypoint 2"]
    visibility: Float[np.ndarray, " keypoint"]
    presence: float
    region: Region
    next_region: Region


class PersonDetector:
    """Finds people in a whole picture; right for a person who fills a good part of it."""

    def __init__(self, card: ModelCard, session: InferenceSession) -> None:
        assert card.detection is not None  # the card's own check
        self._session = session
        self._input = card.input
        self._settings = card.detection
        self._anchors_px = anchors_px(card.input.size_px, card.detection.anchor_strides_px)

    def detect(self, frame: Frame) -> list[DetectedPerson]:
        """Find people, the surest first; none is an empty list."""
        width, height = frame.image_size_px
        whole = Region(centre_px=np.array([width / 2, height / 2]), side_px=float(max(width, height)), rotation_rad=0.0)
        T_frame_crop = whole.T_frame_crop(self._input.size_px)
        image = frame.crop(T_frame_crop, self._input.size_px, self._input.range, border="black")
        output = self._session.run({"image": image[np.newaxis]})
        scores, points = decode_detections(output["boxes"][0], output["scores"][0, :, 0], self._anchors_px)
        people = merge_detections(scores, points, self._settings)
        found = []
        for score, person_points in people:
            hips, top = _transform(T_frame_crop, person_points[2:4])  # after the box's two corners
            found.append(DetectedPerson(score=score, region=region_around(hips, top)))
        return found


class LandmarkModel:
    """Finds the landmarks of the one person in a region."""

    def __init__(self, card: ModelCard, session: InferenceSession) -> None:
        assert card.keypoints is not None  # the card's own check
        assert card.refinement is not None
        self._session = session
        self._input = card.input
        self._refinement = card.refinement
        self._count = len(card.keypoints.names)

    def locate(self, frame: Frame, region: Region) -> PersonLandmarks:
        """Find the landmarks of the person in ``region``; if no one is there, it is noise and ``presence`` is low."""
        T_frame_crop = region.T_frame_crop(self._input.size_px)
        image = frame.crop(T_frame_crop, self._input.size_px, self._input.range)
        output = self._session.run({"image": image[np.newaxis]})
        values = output["landmarks"].reshape(-1, VALUES_PER_POINT).astype(np.float64)
        xy_crop = refine_landmarks(values[:, :2], output["heatmap"][0], self._input.size_px, self._refinement)
        uv_px = _transform(T_frame_crop, xy_crop)
        hips, top = uv_px[self._count : self._count + 2]
        return PersonLandmarks(
            uv_px=uv_px[: self._count],
            visibility=expit(values[: self._count, 3]),
            presence=float(output["presence"].item()),
            region=region,
            next_region=region_around(hips, top),
        )


def region_around(hips_px: Float[np.ndarray, "2"], top_px: Float[np.ndarray, "2"]) -> Region:
    """Give the region of a person from the middle of the hips and a point on the body's circle, above the head.

    (MediaPipe: AlignmentPointsRectsCalculator and RectTransformationCalculator.)
    """
    right, down = top_px - hips_px
    return Region(
        centre_px=hips_px,
        side_px=float(2 * REGION_SCALE * np.hypot(right, down)),
        rotation_rad=float(np.arctan2(right, -down)),
    )


def anchors_px(size_px: int, strides_px: Sequence[int]) -> Float[np.ndarray, "anchor 2"]:
    """Give the anchors of an SSD detector: two at each cell's centre, for each entry of ``strides_px``.

    Entries with the same stride share their cells, one after the other. (MediaPipe: SsdAnchorsCalculator with fixed
    anchor size and one aspect ratio.)
    """
    layers = []
    for stride in dict.fromkeys(strides_px):
        centres = (np.arange(size_px // stride) + 0.5) * stride
        cells = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
        layers.append(np.repeat(cells, 2 * list(strides_px).count(stride), axis=0))
    return np.concatenate(layers)


def decode_detections(
    boxes: Float32[np.ndarray, "anchor values"],
    logits: Float32[np.ndarray, " anchor"],
    anchors: Float[np.ndarray, "anchor 2"],
) -> tuple[Float[np.ndarray, " anchor"], Float[np.ndarray, "anchor point 2"]]:
    """Turn the detector's raw output into scores and points in crop pixels.

    Returns:
        Scores between 0 and 1 (0 where the box has a negative size), and each anchor's points: the box's top-left and
        bottom-right corner, then the keypoints: hips' middle, a point on the body's circle, and two that are not used.
        (MediaPipe: TensorsToDetectionsCalculator.)
    """
    pairs = boxes.astype(np.float64).reshape(len(boxes), -1, 2)
    centres, half_sizes, keypoints = pairs[:, 0] + anchors, pairs[:, 1] / 2, pairs[:, 2:] + anchors[:, np.newaxis]
    corners = np.stack([centres - half_sizes, centres + half_sizes], axis=1)
    scores = np.where((half_sizes >= 0).all(axis=1), expit(logits.astype(np.float64)), 0.0)
    return scores, np.concatenate([corners, keypoints], axis=1)


def merge_detections(
    scores: Float[np.ndarray, " anchor"], points: Float[np.ndarray, "anchor point 2"], settings: Detection
) -> list[tuple[float, Float[np.ndarray, "point 2"]]]:
    """Merge the boxes that overlap the surest one into their mean, weighted by score; go on with the rest.

    (MediaPipe: NonMaxSuppressionCalculator with the algorithm WEIGHTED.)
    """
    left = np.flatnonzero(scores >= settings.min_score)
    left = left[np.argsort(-scores[left], kind="stable")]
    people = []
    while len(left):
        overlap = _intersection_over_union(points[left, :2], points[left[0], :2])
        same = overlap > settings.max_overlap
        same[0] = True  # itself, even if its box has no area
        merged = np.average(points[left[same]], axis=0, weights=scores[left[same]])
        people.append((float(scores[left[0]]), merged))
        left = left[~same]
    return people


def refine_landmarks(
    xy_crop: Float[np.ndarray, "point 2"],
    heatmap_logits: Float32[np.ndarray, "height width point"],
    size_px: int,
    settings: Refinement,
) -> Float[np.ndarray, "point 2"]:
    """Move each landmark to the centre of mass of its heatmap's window around it.

    A landmark stays where it is if it lies outside the crop, or if the window's peak is below ``min_confidence``. Cell
    ``j`` stands for crop pixel ``j * size / cells``, without half a cell more: so the network was trained. (MediaPipe:
    RefineLandmarksFromHeatmapCalculator.)

    Args:
        xy_crop: Landmarks in crop pixels.
        heatmap_logits: One map per landmark.
        size_px: The crop's size, in pixels.
        settings: Window and threshold.
    """
    cells = np.array(heatmap_logits.shape[1::-1])  # (across, down), as x and y
    px_per_cell = size_px / cells
    centre = (xy_crop / px_per_cell).astype(np.intp)  # rounds towards zero, as MediaPipe does
    reach = np.arange(settings.window) - settings.window // 2
    columns, rows = (centre[:, axis, np.newaxis] + reach for axis in (0, 1))
    in_map = ((rows >= 0) & (rows < cells[1]))[:, :, np.newaxis] & ((columns >= 0) & (columns < cells[0]))[
        :, np.newaxis
    ]
    window = heatmap_logits[
        rows.clip(0, cells[1] - 1)[:, :, np.newaxis],
        columns.clip(0, cells[0] - 1)[:, np.newaxis],
        np.arange(len(xy_crop))[:, np.newaxis, np.newaxis],
    ]
    weights = np.where(in_map, expit(window.astype(np.float64)), 0.0)  # (point, row, column)
    total = np.maximum(weights.sum(axis=(1, 2)), np.finfo(float).tiny)
    mean_column = (weights.sum(axis=1) * columns).sum(axis=1) / total
    mean_row = (weights.sum(axis=2) * rows).sum(axis=1) / total
    is_inside = ((centre >= 0) & (centre < cells)).all(axis=1)
    is_peaked = weights.max(axis=(1, 2)) >= settings.min_confidence
    refined = np.column_stack([mean_column, mean_row]) * px_per_cell
    return np.where((is_inside & is_peaked)[:, np.newaxis], refined, xy_crop)


def _transform(T: Float[np.ndarray, "3 3"], xy: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
    return xy @ T[:2, :2].T + T[:2, 2]


def _intersection_over_union(
    boxes: Float[np.ndarray, "box 2 2"], box: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, " box"]:
    """Compare boxes, given by their top-left and bottom-right corners, with one box; no area at all gives 0."""
    sides = np.minimum(boxes[:, 1], box[1]) - np.maximum(boxes[:, 0], box[0])
    common = np.prod(np.maximum(sides, 0.0), axis=1)
    union = np.prod(boxes[:, 1] - boxes[:, 0], axis=1) + np.prod(box[1] - box[0]) - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)
