"""Random damage to files: each reader answers with a result or an InputError that names the file, and never hangs."""

import random
import time
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.external_loads import read_external_loads
from gonio.formats.markerset import read_markerset
from gonio.formats.mot import Table, read_mot, write_mot
from gonio.formats.osim import read_osim
from gonio.formats.osim_setup import read_dynamics_setup, read_kinematics_setup, read_scale_setup
from gonio.formats.trc import Trajectories, read_trc, write_trc
from gonio.kernel.body.forward import marker_positions

ROOT = Path(__file__).resolve().parents[3]
MARKER_TASK = '<IKMarkerTask name="a"><apply>true</apply><weight>2</weight></IKMarkerTask>'
SETUP = f"""<?xml version="1.0"?><OpenSimDocument Version="20302"><{{tool}} name="x"><model_file>m.osim</model_file>
<mass>70</mass><GenericModelMaker><model_file>m.osim</model_file></GenericModelMaker><datafile>f.mot</datafile>
<ModelScaler><scaling_order>measurements manualScale</scaling_order><MeasurementSet><objects><Measurement name="t">
<MarkerPairSet><objects><MarkerPair><markers>a b</markers></MarkerPair></objects></MarkerPairSet>
<BodyScaleSet><objects><BodyScale name="femur"><axes>X Y Z</axes></BodyScale></objects></BodyScaleSet></Measurement>
</objects></MeasurementSet><ScaleSet><objects><Scale><scales>1 2 3</scales><segment>femur</segment></Scale></objects>
</ScaleSet><marker_file>s.trc</marker_file><time_range>1 2</time_range></ModelScaler>
<IKTaskSet><objects>{MARKER_TASK}<IKCoordinateTask name="q"><weight>1</weight><value_type>manual_value</value_type>
<value>0.5</value></IKCoordinateTask></objects></IKTaskSet><marker_file>t.trc</marker_file>
<time_range>0.4 1.6</time_range><results_directory>out</results_directory><forces_to_exclude>Muscles</forces_to_exclude>
<coordinates_file>q.mot</coordinates_file><output_gen_force_file>torques</output_gen_force_file>
<lowpass_cutoff_frequency_for_coordinates>6</lowpass_cutoff_frequency_for_coordinates>
<objects><ExternalForce name="r"><applied_to_body>calcn</applied_to_body><force_identifier>v</force_identifier>
<point_identifier>p</point_identifier></ExternalForce></objects></{{tool}}></OpenSimDocument>"""


def write_samples(folder):
    """One good file of each kind, with its reader."""
    times_s = np.arange(6) / 60
    values = np.random.default_rng(0).normal(size=(6, 3, 3))
    write_trc(folder / "a.trc", Trajectories(names=("a", "b", "c"), times_s=times_s, xyz_m=values, rate_hz=60.0))
    table = Table(name="x", labels=("p", "q"), times_s=times_s, values=values[:, 0, :2], in_degrees=True)
    write_mot(folder / "a.mot", table)
    tools = {
        "InverseKinematicsTool": read_kinematics_setup,
        "ScaleTool": read_scale_setup,
        "InverseDynamicsTool": read_dynamics_setup,
        "ExternalLoads": read_external_loads,
    }
    for tool in tools:
        (folder / f"{tool}.xml").write_text(SETUP.format(tool=tool))
    return [
        (ROOT / "tests/golden/all_joints.osim", read_osim),
        (folder / "a.trc", read_trc),
        (folder / "a.mot", read_mot),
        (ROOT / "models/markersets/coco17.toml", read_markerset),
        *((folder / f"{tool}.xml", reader) for tool, reader in tools.items()),
    ]


TOKENS = [b"", b"nan", b"1e400", b"-1", b"0", b"99999999999999999999", b"/", b"<", b">", b"\x00", b"\xff\xfe", b"\t"]
TOKENS += [
    b"\n",
    b"ground",
    b"<!--",
    b"&lt;",
    b"&x;",
    b"true",
    b"inf",
    b"1 2 3",
    b"../../x",
    b"body0",
    b"[",
    b"=",
    b"'",
]


def damage(content: bytes, source: random.Random) -> bytes:
    """Cut, repeat, swap or overwrite at one to four random places."""
    for _ in range(source.randint(1, 4)):
        start = source.randrange(len(content) + 1)
        length = source.choice([1, 1, 3, 10, 40, 200])
        piece = content[start : start + length]
        new = source.choice(
            [
                source.choice(TOKENS),
                piece * source.choice([0, 2, 3]),
                bytes(source.randrange(256) for _ in piece[:5]),
                content[source.randrange(len(content) + 1) :][:length],
            ]
        )
        content = content[:start] + new + content[start + length :]
        if source.random() < 0.03:
            content = content[: source.randrange(len(content) + 1)]
    return content


def fuzz(folder, count, seed):
    source, samples = random.Random(seed), write_samples(folder)
    originals = [path.read_bytes() for path, _ in samples]
    refused, slowest_s = 0, 0.0
    for number in range(count):
        (path, reader), original = samples[number % len(samples)], originals[number % len(samples)]
        target = folder / f"damaged{path.suffix}"
        target.write_bytes(damage(original, source))
        start = time.perf_counter()
        try:
            result = reader(target)
            if reader is read_osim:
                marker_positions(result, result.coordinates.default[None])
        except InputError as error:
            refused += 1
            assert error.hint, error.message
        slowest_s = max(slowest_s, time.perf_counter() - start)
    return refused, slowest_s


@pytest.mark.parametrize("seed", [1, 2])
def test_damaged_files_are_read_or_refused(tmp_path, seed):
    refused, slowest_s = fuzz(tmp_path, 700, seed)
    assert refused > 50  # the damage reaches the readers' checks
    assert slowest_s < 10.0


@pytest.mark.slow
def test_ten_thousand_damaged_files_are_read_or_refused(tmp_path):
    refused, slowest_s = fuzz(tmp_path, 10_000, 3)
    assert refused > 1000
    assert slowest_s < 10.0
