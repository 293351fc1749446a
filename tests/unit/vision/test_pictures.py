"""The pictures of the report show the subject, however small they are in the video."""

import numpy as np

from gonio.vision.pictures import look_closer


def test_a_small_subject_is_enlarged_and_the_points_stay_on_it():
    picture = np.zeros((540, 720, 3), dtype=np.uint8)
    points = np.array([[600.0, 400.0], [640.0, 500.0], [620.0, 450.0], [np.nan, np.nan]])
    for u, v in points[:3].astype(int):
        picture[v - 2 : v + 3, u - 2 : u + 3] = 255
    closer, places = look_closer(picture, points)
    assert closer.shape == picture.shape
    assert np.isnan(places[3]).all()
    # 1.5 times the 100 of 540 pixels and a tenth are seen, 204 pixels: what was 100 apart is 264.7 apart.
    assert abs(np.ptp(places[:3, 1]) - 100 * 540 / 204) < 0.1
    for u, v in places[:3].round().astype(int):
        assert closer[v, u].min() > 250
        assert closer[v, u + 12].max() < 50  # five pixels became thirteen: half of them and a little is beside it


def test_a_subject_who_fills_the_picture_or_is_not_in_it_leaves_it_as_it_was():
    picture = np.random.default_rng(0).integers(0, 255, (90, 120, 3), dtype=np.uint8)
    for points in (np.array([[2.0, 3.0], [110.0, 85.0]]), np.array([[-5.0, 10.0], [np.nan, np.nan]])):
        closer, places = look_closer(picture, points)
        np.testing.assert_array_equal(closer, picture)
        np.testing.assert_allclose(places, points)
