"""Read a calibration of any format that gonio knows, by what the file holds."""

from pathlib import Path

from gonio.errors import InputError
from gonio.formats.qualisys import read_qualisys_calibration
from gonio.records import Rig


def read_calibration(path: Path) -> Rig:
    """Read the calibrated cameras of a file: Qualisys (``.qca.txt``, ``.xml``).

    Raises:
        InputError: ``calibration-format-unknown`` if no reader knows the file; else what its reader says.
    """
    head = path.read_bytes()[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if head.startswith(b"<"):
        return read_qualisys_calibration(path)
    raise InputError(
        f"{path.name} is in no calibration format that gonio reads.",
        hint="Give the Qualisys calibration (.qca.txt).",
        code="calibration-format-unknown",
    )
