"""One ordinary walk, and a rig to film it."""

import pytest

from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.virtual_lab import make_rig, walk
from gonio.records import BodyModel, MarkerSet, Rig, Walk
from gonio.resources import models_dir


@pytest.fixture(scope="session")
def man() -> BodyModel:
    return read_osim(models_dir() / "bodies" / "fullbody_male.osim")


@pytest.fixture(scope="session")
def walker(man: BodyModel) -> Walk:
    return walk(man, 1.25)


@pytest.fixture(scope="session")
def halpe26() -> MarkerSet:
    return read_markerset(models_dir() / "markersets" / "halpe26.toml")


@pytest.fixture(scope="session")
def ring() -> Rig:
    return make_rig()
