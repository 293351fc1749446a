"""Random streams: apart from each other, and of the stated statistics."""

import numpy as np
import pytest

from gonio.kernel.virtual_lab.chance import correlated, spells, stream


def test_streams_are_apart_and_repeat():
    draws = {key: stream(*key).random(4).tolist() for key in [(1, "a", 0), (2, "a", 0), (1, "b", 0), (1, "a", 1)]}
    assert len({tuple(d) for d in draws.values()}) == 4
    assert stream(1, "a", 0).random(4).tolist() == draws[(1, "a", 0)]


def test_correlated_courses_are_normal_from_the_first_frame_on_and_forget_in_time():
    x = correlated(stream(1, "x", 0), (50, 20000), 60.0, 0.1)
    assert x[0].std() == pytest.approx(1.0, abs=0.03)
    assert x[-1].std() == pytest.approx(1.0, abs=0.03)
    assert np.mean(x[0] * x[6]) == pytest.approx(np.exp(-1.0), abs=0.03)  # 6 frames are 0.1 s


@pytest.mark.parametrize("share", [0.02, 0.13, 0.6])
def test_spells_cover_their_share_from_the_first_frame_on(share):
    rng, covered = stream(1, "spells", 0), np.zeros((2000, 100), dtype=bool)
    for row in covered:
        for spell in spells(rng, 100, 60.0, share, (5 / 60, 20 / 60)):
            assert 1 <= spell.stop - spell.start <= 20
            row[spell] = True
    # 2000 recordings, each frame a draw of its own: sd below 1.2 %; rounding of lengths to whole frames adds as much.
    assert covered.mean() == pytest.approx(share, rel=0.06)
    assert covered[:, 0].mean() == pytest.approx(share, abs=0.04)


def test_no_share_is_no_spell():
    assert spells(stream(1, "spells", 0), 1000, 60.0, 0.0, (0.1, 0.2)) == []
