"""Frames are built from planes here, so that each number can be worked out by hand."""

import numpy as np
import pytest

from gonio.vision.frame import BT601, BT709, Colour, Frame

GREY = Colour.of(*BT601, full_range=True)


def frame_of(luma: np.ndarray, rotation_deg: int = 0, colour: Colour = GREY) -> Frame:
    """A grey picture."""
    height, width = luma.shape
    chroma = np.full(((height + 1) // 2, (width + 1) // 2), 128, np.uint8)
    return Frame(index=0, time_s=0.0, planes=(luma, chroma, chroma), rotation_deg=rotation_deg, colour=colour)


@pytest.mark.parametrize(
    ("yuv", "rgb"),
    [
        ((16, 128, 128), (0, 0, 0)),
        ((235, 128, 128), (1, 1, 1)),
        ((81, 90, 240), (1, 0, 0)),
        ((41, 240, 110), (0, 0, 1)),
    ],
)
def test_bt601_limited_range(yuv: tuple[int, ...], rgb: tuple[int, ...]) -> None:
    """Black, white, red and blue as the recommendation rounds them: half a step of 219 and its gain of 2 is 0.005."""
    colour = Colour.of(*BT601, full_range=False)
    np.testing.assert_allclose(colour.matrix @ (yuv - colour.black), rgb, atol=0.006)


def test_full_range_and_bt709() -> None:
    colour = Colour.of(*BT709, full_range=True)
    np.testing.assert_allclose(colour.matrix @ ([255, 128, 128] - colour.black), [1, 1, 1], atol=1e-12)
    # Pure green has Y = K_G; U = -K_G / (2 (1 - K_B)), V = -K_G / (2 (1 - K_R)).
    y, u, v = 0.7152, -0.7152 / (2 * 0.9278), -0.7152 / (2 * 0.7874)
    yuv = np.array([255 * y, 128 + 255 * u, 128 + 255 * v])
    np.testing.assert_allclose(colour.matrix @ (yuv - colour.black), [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(("rotation_deg", "turns"), [(0, 0), (90, -1), (180, 2), (270, 1)])
def test_crop_and_thumbnail_honour_the_rotation(rotation_deg: int, turns: int) -> None:
    luma = np.random.default_rng(1).integers(0, 256, (6, 10)).astype(np.uint8)
    frame, viewed = frame_of(luma, rotation_deg), np.rot90(luma, turns)
    assert frame.image_size_px == viewed.shape[::-1]
    np.testing.assert_array_equal(frame.rgb()[..., 0], viewed)
    np.testing.assert_allclose(frame.crop(np.eye(3), 6, (0.0, 255.0))[..., 1], viewed[:6, :6], atol=1e-3)


def test_a_crop_is_bilinear_between_pixel_centres() -> None:
    ramp = np.tile(np.arange(0, 200, 10, dtype=np.uint8), (20, 1))
    T_frame_crop = np.array([[2.0, 0, 3.5], [0, 2.0, 4.0], [0, 0, 1]])
    crop = frame_of(ramp).crop(T_frame_crop, 8, (0.0, 255.0))
    np.testing.assert_allclose(
        crop[..., 0], np.tile(10 * (3.5 + 2 * np.arange(8)), (8, 1)), atol=0.51
    )  # rounded planes


def test_a_crop_scales_its_values_and_shows_a_border() -> None:
    frame = frame_of(np.full((4, 4), 255, np.uint8))
    T_frame_crop = np.array([[1.0, 0, -4], [0, 1.0, -4], [0, 0, 1]])
    black = frame.crop(T_frame_crop, 12, (-1.0, 1.0), border="black")
    assert black.dtype == np.float32
    np.testing.assert_allclose(black[0, 0], -1, atol=0.01)
    np.testing.assert_allclose(black[5, 5], 1, atol=0.01)
    np.testing.assert_allclose(frame.crop(T_frame_crop, 12, (-1.0, 1.0)), 1, atol=0.01)


def test_planes_with_padded_lines_and_odd_sizes() -> None:
    padded = np.random.default_rng(2).integers(0, 256, (7, 32)).astype(np.uint8)
    frame = frame_of(padded[:, :9])
    np.testing.assert_allclose(frame.crop(np.eye(3), 7, (0.0, 255.0))[..., 2], padded[:, :7], atol=1e-3)


def test_a_thumbnail_is_shrunk_but_never_enlarged() -> None:
    frame = frame_of(np.zeros((40, 100), np.uint8), rotation_deg=90)
    assert frame.rgb(max_side_px=50).shape == (50, 20, 3)
    assert frame.rgb(max_side_px=500).shape == (100, 40, 3)
