"""Film the tutorial without phones: a board that is swept before four virtual cameras, then a person who walks past them.

`python virtual_phones.py FOLDER` writes `FOLDER/board` (a video of the board a camera, and the lenses, as if each had been
filmed alone before) and `FOLDER/walk` (each camera's keypoints in OpenPose's files, since no network finds a person in a
drawing, and the stream of pressure soles).
"""

import sys
from pathlib import Path

from gonio.bench.board_sessions import Filming, write_films
from gonio.bench.board_sessions import film as film_board
from gonio.demo.virtual import RATE_HZ, film_walk, write_session
from gonio.formats.board_card import load_board_card
from gonio.formats.toml_calibration import write_toml_calibration

folder = Path(sys.argv[1])
board = load_board_card("charuco_a0").board
filming = Filming(board=board, poses=110, radius_m=4.2, image_size_px=(1280, 960), focal_px=1000.0)
session = film_board(seed=1, filming=filming)
write_films(session, folder / "board")
write_toml_calibration(folder / "board" / "optics.toml", session.rig)
trial = film_walk(rig=session.rig)
for path in write_session(trial, folder / "walk"):
    if path.suffix == ".toml":
        path.unlink()  # the true calibration: the tutorial makes its own
print(f"{folder}: {len(session.rig.cameras)} cameras, {RATE_HZ:g} Hz")
