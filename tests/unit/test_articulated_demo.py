"""The demo's files are what the solver takes, and its answer is near the truth."""

from pathlib import Path

from gonio.demo.articulated import NOISE_PX, SEED, off_by_deg, write_object
from gonio.kernel.virtual_lab.articulated import BODIES, virtual_body
from gonio.pipeline.articulated import solve_folder


def test_the_demos_files_are_solved(tmp_path: Path) -> None:
    body = virtual_body(BODIES["mannequin"], SEED, noise_px=NOISE_PX)
    write_object(body, tmp_path)
    document = solve_folder(tmp_path)
    worst = off_by_deg(document, body)
    assert list(worst) == ["base", "shoulder"]
    for joint in document.joints:
        assert worst[joint.part] < 4 * max(picture.turn_sd_deg for picture in joint.pictures)
