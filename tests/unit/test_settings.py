from pathlib import Path

import pytest
from pydantic import ValidationError

from gonio.settings import Settings


def test_defaults_are_those_of_a_laptop(monkeypatch):
    monkeypatch.delenv("GONIO_DATA_DIR", raising=False)
    settings = Settings()
    assert (settings.host, settings.port, settings.workers) == ("127.0.0.1", 8000, 1)
    assert settings.resolved_database_url == f"sqlite:///{settings.data_dir / 'gonio.db'}"
    assert settings.resolved_objects_url.startswith("file:///")


def test_the_environment_is_read_and_an_empty_variable_is_none(monkeypatch, tmp_path):
    monkeypatch.setenv("GONIO_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("GONIO_PORT", "")
    monkeypatch.setenv("GONIO_WORKERS", "3")
    settings = Settings()
    assert settings.resolved_database_url == f"sqlite:///{tmp_path / 'gonio.db'}"
    assert (settings.port, settings.workers) == (8000, 3)
    assert settings.data_dir == Path(tmp_path)


def test_services_that_share_a_cache_do_not_share_their_work(tmp_path):
    one, other = (Settings(data_dir=tmp_path / name, cache_dir=tmp_path / "cache") for name in ("one", "other"))
    assert one.work_dir != other.work_dir
    assert one.work_dir.parent == other.work_dir.parent == tmp_path / "cache" / "work"


def test_nonsense_is_refused():
    with pytest.raises(ValidationError):
        Settings(port=70000)
