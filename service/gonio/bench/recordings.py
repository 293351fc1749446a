"""The real recordings that benches measure on: read beside the checkout, never part of it."""

from pathlib import Path

from gonio.errors import ResourceError

_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"

GAIT2354 = _DATA / "opensim_gait2354"
BALANCING = _DATA / "pose2sim_balancing"
CALISCOPE_SESSION = _DATA / "caliscope_charuco"
VICON_PIG = _DATA / "vicon_pig"
INSOLE_ISCAS = _DATA / "insole_iscas"

_WHAT = {
    GAIT2354: "OpenSim's Gait2354 example",
    BALANCING: "Pose2Sim's balancing trial",
    CALISCOPE_SESSION: "Caliscope's session",
    VICON_PIG: "BTK's Plug-in Gait trial",
    INSOLE_ISCAS: "the insole stream of ISCAS 2025",
}


def need(recording: Path) -> Path:
    """Give the recording's folder.

    Raises:
        ResourceError: It is not there (``bench-data-missing``).
    """
    if not recording.is_dir():
        raise ResourceError(
            f"A recording is not there: {_WHAT[recording]}.",
            hint=f"Put it into {recording}.",
            code="bench-data-missing",
        )
    return recording
