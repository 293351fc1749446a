"""The corners that are found in a drawn picture are where the camera projects them; the part map is the true mask."""

from dataclasses import replace

import numpy as np

from gonio.kernel.geometry.cameras import project
from gonio.kernel.geometry.transforms import apply, transform
from gonio.kernel.virtual_lab.articulated import virtual_cameras
from gonio.vision.masks import cut_out
from gonio.vision.render_parts import HUES, Box, find_marks, paper, photograph


def test_marks_are_found_where_they_are_and_masks_where_parts_are() -> None:
    camera = virtual_cameras(np.random.default_rng(4), 1)[0]
    camera = replace(
        camera, image_size_px=(1440, 1080),
        intrinsic_px=np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1.0]]) @ camera.intrinsic_px,
    )  # fmt: skip
    part = paper((Box(np.array([0.0, 0.25, 0.0]), np.array([0.25, 0.5, 0.25])),), 7, HUES[0])
    T = transform(np.eye(3), np.array([0.05, 0.0, -0.1]))
    photo = photograph(camera, (part,), (T,))
    found = find_marks(photo, part.tags)
    seen = np.isfinite(found[:, 0, 0])
    assert seen.sum() >= 10
    off = found[seen] - project(camera, apply(T, part.marks_m))[seen]
    # Corners of 40 px markers, blurred by 0.5 px, with 2 of 255 noise: a tenth or two of a pixel, and no bias.
    assert np.sqrt((off**2).mean()) < 0.3
    assert np.abs(off.mean(axis=(0, 1))).max() < 0.05
    truth = photo.shown(0)
    rows, columns = (np.flatnonzero(truth.any(axis=axis)) for axis in (1, 0))
    corners = project(
        camera, apply(T, np.array([[x, y, z] for x in (-0.125, 0.125) for y in (0, 0.5) for z in (-0.125, 0.125)]))
    )
    assert np.abs(np.array([columns[0], rows[0]]) - corners.min(axis=0)).max() <= 1
    assert np.abs(np.array([columns[-1], rows[-1]]) - corners.max(axis=0)).max() <= 1
    cut = cut_out(photo.rgb, (int(columns[0]) - 4, int(rows[0]) - 4, int(columns[-1]) + 5, int(rows[-1]) + 5))
    assert (cut & truth).sum() / (cut | truth).sum() > 0.97
