"""Rivals, each in an environment of its own: their requirements never meet ours."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from gonio.errors import ResourceError


def peer_python(build_dir: Path, name: str, *requirements: str) -> Path:
    """Give the Python of a rival's environment, ``build/peers/<name>``, made on the first call.

    Raises:
        ResourceError: The environment can't be made (``peer-missing``): there is no network, or no such package.
    """
    folder = (build_dir / "peers" / name).resolve()
    python, stamp = folder / "bin" / "python", folder / "requirements"
    wanted = "\n".join(requirements)
    if not stamp.is_file() or stamp.read_text() != wanted:
        shutil.rmtree(folder, ignore_errors=True)
        _run([sys.executable, "-m", "venv", str(folder)], name)
        _run([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements], name)
        stamp.write_text(wanted)
    return python


def run_in_peer(python: Path, script: str, *arguments: str | Path) -> None:
    """Run a script of ``gonio/bench/in_peers`` in a rival's environment, where gonio itself can't be imported.

    Raises:
        ResourceError: It failed (``peer-missing``).
    """
    path = Path(__file__).parent / "in_peers" / f"{script}.py"
    _run([str(python), "-I", str(path), *map(str, arguments)], script)


def _run(command: Sequence[str], name: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)  # noqa: S603 - ours
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise ResourceError(
            f"The rival {name} can't be run: {said}",
            hint="It is installed by pip on the first run, which needs a network.",
            code="peer-missing",
        )
