"""The hull against an exact polyhedron, and against each voxel asked alone; its colours, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from gonio.bench.joints.carving import around, exact_hull_m3, silhouettes
from gonio.errors import CaptureError, InputError
from gonio.kernel.carving.hull import LEAST_SEEN, carve
from gonio.kernel.carving.surface import carve_part, surface_of
from gonio.kernel.carving.views import HIDDEN, SHOWN, Stack, stack_of, view_of
from gonio.kernel.virtual_lab.articulated import virtual_cameras
from gonio.records import Camera


def asked_one_by_one(stack: Stack, xyz_m: np.ndarray) -> np.ndarray:
    seen, denied = np.zeros(xyz_m.shape[:-1], int), np.zeros(xyz_m.shape[:-1], bool)
    for P, (height, width), codes in zip(stack.P, stack.sizes, stack.codes, strict=True):
        image = xyz_m @ P[:, :3].T + P[:, 3]
        u, v = (np.floor(image[..., k] / image[..., 2] + 0.5).astype(int) for k in (0, 1))
        inside = (image[..., 2] > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        code = np.where(inside, codes[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0)
        denied |= code == 0
        seen += code == SHOWN
    return ~denied & (seen >= LEAST_SEEN)


@pytest.mark.parametrize("cameras", [around(4), around(9), virtual_cameras(np.random.default_rng(1), 4)])
def test_the_volume_is_that_of_the_exact_hull(cameras: tuple[Camera, ...]) -> None:
    hull = carve(stack_of(tuple(view_of(s) for s in silhouettes(cameras))), 96)
    # A filled polygon's border pixels are drawn too, half a pixel beyond the outline of one that is 80 or more wide: 2 %
    # in volume, and the voxels' own rounding.
    assert hull.volume_m3 == pytest.approx(exact_hull_m3(cameras), rel=0.05)


def test_blocks_change_nothing() -> None:
    seen = list(silhouettes(around(4)))
    hidden = np.zeros_like(seen[0].shown)
    hidden[300:420, 560:680] = True
    seen[0] = replace(seen[0], shown=seen[0].shown & ~hidden, hidden=hidden)
    stack = stack_of(tuple(view_of(s) for s in seen))
    assert (stack.codes[0] == HIDDEN).any()
    hull = carve(stack, 90)
    at = np.moveaxis(np.indices(hull.occupied.shape), 0, -1) * hull.step_m + hull.corner_m
    np.testing.assert_array_equal(hull.occupied, asked_one_by_one(stack, at))
    # Nothing of the hull lies outside the box that was searched: its faces' outermost layers are empty or just reached.
    around_it = np.moveaxis(np.indices(np.array(hull.occupied.shape) + 20), 0, -1) - 10
    whole = asked_one_by_one(stack, around_it * hull.step_m + hull.corner_m)
    assert whole.sum() == pytest.approx(hull.occupied.sum(), rel=1e-3)


def test_what_is_hidden_in_one_picture_is_not_carved_away() -> None:
    seen = list(silhouettes(around(6)))
    hidden = np.zeros_like(seen[0].shown)
    hidden[:, :640] = True
    blocked = replace(seen[0], shown=seen[0].shown & ~hidden, hidden=hidden)
    taken = replace(seen[0], shown=blocked.shown)
    whole, kept, lost = (carve_part((each, *seen[1:]), 64) for each in (seen[0], blocked, taken))
    assert whole.volume_m3 <= kept.volume_m3 * 1.02 < 1.25 * whole.volume_m3
    assert lost.volume_m3 < 0.7 * whole.volume_m3
    assert kept.overlap.min() > 0.93
    assert lost.overlap[1:].min() < 0.8


@pytest.mark.parametrize("distortion", [0.0, -0.2, 0.2])
def test_the_surface_covers_the_silhouettes_and_has_their_colour(distortion: float) -> None:
    part = carve_part(silhouettes(around(6, distortion)), 96)
    assert part.overlap.min() > 0.96
    assert part.mesh.coloured.mean() > 0.7
    colours = part.mesh.rgb[part.mesh.coloured]
    assert (np.abs(colours.astype(int) - (200, 90, 30)) <= 1).all()
    assert (part.mesh.rgb[~part.mesh.coloured] == 128).all()


def test_the_surface_is_closed_and_holds_the_volume_of_the_voxels() -> None:
    hull = carve(stack_of(tuple(view_of(s) for s in silhouettes(around(6)))), 96)
    mesh = surface_of(hull)
    a, b, c = (mesh.xyz_m[mesh.faces[:, k]] for k in range(3))
    # The divergence theorem; the sign says that the triangles are counter-clockwise from outside.
    assert np.einsum("fk,fk->", a, np.cross(b, c)) / 6 == pytest.approx(hull.volume_m3, rel=0.01)
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    outward = np.einsum("fk,fk->f", np.cross(b - a, c - a), mesh.normals[mesh.faces[:, 0]])
    assert (outward > 0).mean() > 0.99


def test_a_part_that_others_hide_widely_is_bounded_by_the_pictures_that_show_it() -> None:
    seen = silhouettes(around(4))
    # Two pictures that are hidden but for a corner of the part, from one side, and two that show it from across.
    far = [replace(each, hidden=~each.shown) for each in seen]
    with_hidden = carve_part((seen[0], seen[1], far[2], far[3]), 64)
    two = carve_part((seen[0], seen[1]), 64)
    assert with_hidden.volume_m3 == pytest.approx(two.volume_m3, rel=0.02)
    # All wide but for what two of them show: no picture alone has an end, and the hull is what any two show.
    assert np.isfinite(carve_part(tuple(far), 64).mesh.xyz_m).all()


def test_bad_silhouettes_are_refused_by_name() -> None:
    good = silhouettes(around(4))
    with pytest.raises(InputError) as refused:
        carve_part((replace(good[0], shown=good[0].shown[:-1], hidden=good[0].hidden[:-1], rgb=None), *good[1:]))
    assert refused.value.code == "mask-wrong-size"
    with pytest.raises(InputError) as refused:
        carve_part((replace(good[0], shown=good[0].hidden), *good[1:]))
    assert refused.value.code == "mask-empty"
    aside = np.roll(good[1].shown, 400, axis=1)
    with pytest.raises(CaptureError) as failed:
        carve_part((good[0], replace(good[1], shown=aside), *good[2:]))
    assert failed.value.code == "hull-empty"
    with pytest.raises(CaptureError) as failed:
        carve_part((good[0], good[0]))
    assert failed.value.code == "hull-unbounded"
