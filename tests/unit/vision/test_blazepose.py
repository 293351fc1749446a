"""The steps of MediaPipe's graph, each on numbers that can be worked out by hand or in a plain loop."""

import numpy as np
import pytest
from scipy.special import expit, logit

from gonio.vision.blazepose import (
    LandmarkModel,
    PersonDetector,
    Region,
    anchors_px,
    decode_detections,
    merge_detections,
    refine_landmarks,
    region_around,
)
from gonio.vision.frame import BT601, Colour, Frame
from gonio.vision.model_cards import Detection, Refinement, load_card

DETECTION = Detection(anchor_strides_px=(8, 16, 32, 32, 32), min_score=0.5, max_overlap=0.3)
REFINEMENT = Refinement(window=7, min_confidence=0.5)


class SessionFake:
    """Answers every picture with the same output and remembers the pictures."""

    def __init__(self, **outputs: np.ndarray) -> None:
        self.outputs = {name: np.asarray(value, np.float32)[np.newaxis] for name, value in outputs.items()}
        self.images: list[np.ndarray] = []

    def run(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self.images.append(inputs["image"])
        return self.outputs


def grey_frame(width: int, height: int) -> Frame:
    planes = [np.full(shape, 128, np.uint8) for shape in ((height, width), *[(height // 2, width // 2)] * 2)]
    return Frame(
        index=0, time_s=0.0, planes=tuple(planes), rotation_deg=0, colour=Colour.of(*BT601, full_range=True)
    )  # fmt: skip


def test_the_crop_of_an_upright_region_is_mediapipes() -> None:
    """Pixel i of the crop lies at centre + (i - n / 2) side / n, as OpenCV's warp of MediaPipe's corners has it."""
    T = Region(centre_px=np.array([100.0, 50.0]), side_px=64.0, rotation_rad=0.0).T_frame_crop(256)
    np.testing.assert_allclose(T @ [0, 0, 1], [100 - 32, 50 - 32, 1])
    np.testing.assert_allclose(T @ [256, 128, 1], [100 + 32, 50, 1])


@pytest.mark.parametrize(
    ("top", "rotation_deg"), [((0, -10), 0), ((10, 0), 90), ((0, 10), 180), ((-10, 0), -90), ((7, -7), 45)]
)
def test_a_region_turns_the_person_upright(top: tuple[float, float], rotation_deg: float) -> None:
    hips = np.array([300.0, 400.0])
    region = region_around(hips, hips + top)
    assert np.rad2deg(region.rotation_rad) == pytest.approx(rotation_deg)
    assert region.side_px == pytest.approx(2.5 * np.hypot(*top))
    x, y, _ = np.linalg.solve(region.T_frame_crop(256), [*(hips + top), 1])
    assert (x, y) == pytest.approx((128, 128 - 256 / 2.5))  # straight above the crop's middle


def test_anchors_are_those_of_the_detector() -> None:
    anchors = anchors_px(224, DETECTION.anchor_strides_px)
    assert anchors.shape == (2254, 2)  # 28² · 2 + 14² · 2 + 7² · 6
    np.testing.assert_array_equal(anchors[:4], [[4, 4], [4, 4], [12, 4], [12, 4]])
    np.testing.assert_array_equal(anchors[28 * 28 * 2], [8, 8])
    np.testing.assert_array_equal(anchors[-6:], [[208, 208]] * 6)


def test_decode_detections() -> None:
    anchors = np.array([[4.0, 4.0], [12.0, 4.0]])
    boxes = np.array([[1, 2, 10, 20, 5, 6, 7, 8, 0, 0, 0, 0], [0, 0, -1, 5, *[0] * 8]], np.float32)
    scores, points = decode_detections(boxes, np.array([0.0, 200.0], np.float32), anchors)
    np.testing.assert_array_equal(scores, [0.5, 0.0])  # a negative width is no detection, however sure
    np.testing.assert_array_equal(points[0, :4], [[0, -4], [10, 16], [9, 10], [11, 12]])


def test_overlapping_detections_are_averaged_by_score() -> None:
    def person(x: float) -> np.ndarray:
        return np.array([[x, 0], [x + 10, 10], [x + 5, 5], [x + 5, 0]], dtype=float)

    points = np.stack([person(0), person(1), person(100), person(2)])
    merged = merge_detections(np.array([0.6, 0.9, 0.7, 0.4]), points, DETECTION)
    assert [score for score, _ in merged] == [0.9, 0.7]
    np.testing.assert_allclose(merged[0][1], (0.6 * person(0) + 0.9 * person(1)) / 1.5)  # 0.4 is below the threshold
    np.testing.assert_allclose(merged[1][1], person(100))


def test_no_detection_and_one_without_an_area() -> None:
    assert merge_detections(np.array([0.1]), np.zeros((1, 4, 2)), DETECTION) == []
    ((score, points),) = merge_detections(np.array([0.8]), np.ones((1, 4, 2)), DETECTION)
    assert score == 0.8
    np.testing.assert_array_equal(points, np.ones((4, 2)))


def refine_in_a_loop(xy: np.ndarray, heatmap: np.ndarray) -> np.ndarray:
    """MediaPipe's loop, word by word."""
    refined = xy.copy()
    height, width, _ = heatmap.shape
    for point, (x, y) in enumerate(xy / 256):
        centre_column, centre_row = int(x * width), int(y * height)
        if not (0 <= centre_column < width and 0 <= centre_row < height):
            continue
        total = column_sum = row_sum = peak = 0.0
        for row in range(max(0, centre_row - 3), min(height, centre_row + 4)):
            for column in range(max(0, centre_column - 3), min(width, centre_column + 4)):
                weight = expit(float(heatmap[row, column, point]))
                total, peak = total + weight, max(peak, weight)
                column_sum, row_sum = column_sum + weight * column, row_sum + weight * row
        if peak >= 0.5 and total > 0:
            refined[point] = column_sum / width / total * 256, row_sum / height / total * 256
    return refined


def test_refinement_is_mediapipes_loop() -> None:
    rng = np.random.default_rng(11)
    xy = rng.uniform(-20, 276, (200, 2))  # also outside the crop, and at its borders
    xy[:4] = [[0, 0], [255.9, 255.9], [-0.5, 100], [256, 100]]
    heatmap = rng.normal(-6, 3, (64, 64, 200)).astype(np.float32)
    refined = refine_landmarks(xy, heatmap, 256, REFINEMENT)
    np.testing.assert_allclose(refined, refine_in_a_loop(xy, heatmap), atol=1e-9)
    moved = (refined != xy).any(axis=1)
    assert 20 < moved.sum() < 180


def test_refinement_finds_a_single_peak() -> None:
    heatmap = np.full((64, 64, 1), -30.0, np.float32)
    heatmap[20, 30] = 5.0
    np.testing.assert_allclose(
        refine_landmarks(np.array([[113.0, 87.0]]), heatmap, 256, REFINEMENT), [[120, 80]], atol=1e-6
    )


def test_the_detector_sees_the_whole_frame_between_black_borders() -> None:
    card = load_card("blazepose_detector")
    boxes, scores = np.zeros((2254, 12)), np.full((2254, 1), -100.0)
    # The last anchor (208, 208) of the 224 × 224 picture: hips at (112, 112), the circle's top 28 px above.
    boxes[-1] = [-96, -96, 56, 56, -96, -96, -96, -124, 0, 0, 0, 0]
    scores[-1] = logit(0.9)
    session = SessionFake(boxes=boxes, scores=scores)
    (person,) = PersonDetector(card, session).detect(grey_frame(224, 448))
    assert person.score == pytest.approx(0.9)
    np.testing.assert_allclose(person.region.centre_px, [112, 224])
    assert person.region.side_px == pytest.approx(2.5 * 56)  # two frame pixels a crop pixel
    assert person.region.rotation_rad == 0
    image = session.images[0][0]
    assert (image.shape, image.dtype) == ((224, 224, 3), np.float32)
    np.testing.assert_allclose(image[:, :50], -1, atol=0.01)
    np.testing.assert_allclose(image[:, 60:160], 2 * 128 / 255 - 1, atol=0.01)


def test_nobody_in_view() -> None:
    session = SessionFake(boxes=np.zeros((2254, 12)), scores=np.full((2254, 1), -100.0))
    assert PersonDetector(load_card("blazepose_detector"), session).detect(grey_frame(64, 48)) == []


def test_landmarks_come_back_to_the_frame() -> None:
    values = np.zeros((39, 5))
    values[:, 0], values[:, 1] = np.linspace(20, 200, 39), 128
    values[:, 3] = logit(0.8)
    values[33, :2], values[34, :2] = (128, 128), (128, 128 - 51.2)
    session = SessionFake(landmarks=values.ravel(), presence=[0.97], heatmap=np.full((64, 64, 39), -30.0))
    region = Region(centre_px=np.array([500.0, 300.0]), side_px=512.0, rotation_rad=np.pi / 2)
    person = LandmarkModel(load_card("blazepose_heavy"), session).locate(grey_frame(64, 48), region)
    assert person.uv_px.shape == (33, 2)
    # The crop is turned clockwise by 90°, at 2 frame pixels a crop pixel: its right is the frame's down.
    np.testing.assert_allclose(person.uv_px[0], [500, 300 + 2 * (20 - 128)])
    np.testing.assert_allclose(person.visibility, 0.8, atol=1e-6)
    assert person.presence == pytest.approx(0.97)
    assert person.region is region
    np.testing.assert_allclose(person.next_region.centre_px, [500, 300])
    assert person.next_region.side_px == pytest.approx(2.5 * 2 * 51.2)
    assert person.next_region.rotation_rad == pytest.approx(np.pi / 2)  # the crop's up is the frame's right
