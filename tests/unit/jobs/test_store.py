import os

import obstore
import pytest
from obstore.store import MemoryStore

from gonio.errors import GonioError
from gonio.jobs.store import Store, Stored


@pytest.fixture(params=["folder", "bucket"])
def store(request, tmp_path) -> Store:
    if request.param == "bucket":
        return Store(MemoryStore())
    return Store.open((tmp_path / "a folder ü").as_uri())


def test_bytes_and_files_come_back(store, tmp_path):
    stored = store.put_bytes("labs/x", "a b.npz", b"hello")
    assert store.get_bytes(stored) == b"hello"
    assert stored.size == 5
    (tmp_path / "report.html").write_bytes(b"page")
    page = store.put_file("labs/x", "report.html", tmp_path / "report.html")
    with store.local_path(page.key) as path:
        assert path.read_bytes() == b"page"
    assert (tmp_path / "report.html").exists()


def test_other_content_never_takes_the_place_of_an_object(store):
    first, second = (store.put_bytes("labs/x", "name", content) for content in (b"1", b"2"))
    assert first.key != second.key
    assert store.get_bytes(first) == b"1"
    assert store.put_bytes("labs/x", "name", b"1") == first


def test_a_taken_file_is_moved(store, tmp_path):
    path = tmp_path / "cam.mp4"
    path.write_bytes(b"x" * 3_000_000)
    store.take_file("labs/x/files/1", path)
    assert not path.exists()
    with store.local_path("labs/x/files/1") as content:
        assert content.stat().st_size == 3_000_000


def test_a_taken_file_is_copied_from_another_disk(tmp_path, monkeypatch):
    store = Store.open((tmp_path / "objects").as_uri())
    path = tmp_path / "cam.mp4"
    path.write_bytes(b"x")

    def across_disks(*_):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "rename", across_disks)
    store.take_file("labs/x/files/1", path)
    assert not path.exists()
    with store.local_path("labs/x/files/1") as content:
        assert content.read_bytes() == b"x"


def test_a_damaged_or_missing_artefact_is_noticed(store):
    stored = store.put_bytes("labs/x", "stage.npz", b"hello")
    obstore.put(store._objects, stored.key, b"hellO")
    for wrong in (stored, Stored("labs/x/nothing", stored.sha256, 5)):
        with pytest.raises(GonioError) as caught:
            store.get_bytes(wrong)
        assert caught.value.code == "artefact-damaged"


def test_deleting_a_prefix_takes_all_below_it_and_nothing_beside_it(store):
    kept = store.put_bytes("labs/x/sessions/12", "a", b"kept")
    gone = [store.put_bytes("labs/x/sessions/1", name, b"gone") for name in ("a", "b")]
    store.delete("labs/x/sessions/1")
    store.delete("labs/x/sessions/1")
    assert store.get_bytes(kept) == b"kept"
    for stored in gone:
        with pytest.raises(GonioError, match="no longer in the store"), store.local_path(stored.key):
            pass


def test_one_object_is_deleted_by_its_key(store, tmp_path):
    (tmp_path / "f").write_bytes(b"x")
    store.take_file("labs/x/files/1", tmp_path / "f")
    store.delete("labs/x/files/1")
    with pytest.raises(GonioError, match="no longer in the store"), store.local_path("labs/x/files/1"):
        pass
