"""OpenSim's setup files, run unchanged: on the built-in body, and on OpenSim's own example where it is at hand."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.mot import read_mot
from gonio.formats.osim import read_osim
from gonio.formats.trc import Trajectories, write_trc
from gonio.kernel.body.forward import marker_positions
from gonio.kernel.body.scaling import scale_model
from gonio.pipeline.opensim_tools import run_kinematics, run_scale

ROOT = Path(__file__).resolve().parents[3]
BODY = ROOT / "models" / "bodies" / "fullbody_female.osim"
EXAMPLE = ROOT.parent / "shared" / "data" / "opensim_gait2354"

TASKS = "".join(
    f'<IKMarkerTask name="{name}"><apply>true</apply><weight>{weight}</weight></IKMarkerTask>'
    for name, weight in (
        ("hip_r", 2),
        ("hip_l", 2),
        ("shoulder_r", 1),
        ("shoulder_l", 1),
        ("knee_r", 3),
        ("ankle_r", 3),
    )
)
IK = f"""<OpenSimDocument Version="40000"><InverseKinematicsTool name="walk"><model_file>body.osim</model_file>
<IKTaskSet><objects>{TASKS}<IKCoordinateTask name="lumbar_extension"><weight>100</weight>
<value_type>default_value</value_type></IKCoordinateTask></objects></IKTaskSet><marker_file>walk.trc</marker_file>
<time_range>0.1 0.5</time_range><output_motion_file>walk.mot</output_motion_file>
</InverseKinematicsTool></OpenSimDocument>"""
SCALE = f"""<OpenSimDocument Version="20303"><ScaleTool name="person"><mass>61.5</mass>
<GenericModelMaker><model_file>body.osim</model_file></GenericModelMaker>
<ModelScaler><scaling_order> measurements manualScale </scaling_order><MeasurementSet><objects>
<Measurement name="thigh"><MarkerPairSet><objects><MarkerPair><markers> hip_r knee_r </markers></MarkerPair></objects>
</MarkerPairSet><BodyScaleSet><objects><BodyScale name="femur_r"><axes> X Y Z </axes></BodyScale>
<BodyScale name="patella_r"><axes> X Y Z </axes></BodyScale></objects></BodyScaleSet></Measurement></objects></MeasurementSet>
<ScaleSet><objects><Scale><scales>1.1 1.2 1.3</scales><segment>torso</segment><apply>true</apply></Scale></objects></ScaleSet>
<marker_file>walk.trc</marker_file><time_range>0 1</time_range>
<preserve_mass_distribution>true</preserve_mass_distribution><output_model_file>scaled.osim</output_model_file>
<output_scale_file>factors.xml</output_scale_file></ModelScaler>
<MarkerPlacer><IKTaskSet><objects>{TASKS}</objects></IKTaskSet><marker_file>walk.trc</marker_file>
<time_range>0 0.1</time_range><output_motion_file>static.mot</output_motion_file>
<output_model_file>placed.osim</output_model_file></MarkerPlacer></ScaleTool></OpenSimDocument>"""


@pytest.fixture
def folder(tmp_path):
    """A trial of the built-in body with a right thigh of 110 %, and setups beside it."""
    model = read_osim(BODY)
    factors = np.ones((len(model.bodies.names), 3))
    factors[model.bodies.index("femur_r")] = 1.1
    q = np.tile(model.coordinates.default, (61, 1))
    q[:, model.coordinates.index("pelvis_tx")] = np.linspace(0, 1, 61)
    seen = marker_positions(scale_model(model, factors), q)
    trial = Trajectories(names=model.markers.names, times_s=np.arange(61) / 60, xyz_m=seen, rate_hz=60.0)
    write_trc(tmp_path / "walk.trc", trial)
    (tmp_path / "body.osim").write_bytes(BODY.read_bytes())
    (tmp_path / "ik.xml").write_text(IK)
    (tmp_path / "scale.xml").write_text(SCALE)
    return tmp_path


def test_inverse_kinematics_of_a_setup(folder):
    motion, result = run_kinematics(folder / "ik.xml")
    assert result.files == (folder / "walk.mot",)
    written = read_mot(folder / "walk.mot")
    assert written.in_degrees
    assert written.times_s[[0, -1]].tolist() == pytest.approx([0.1, 0.5])
    np.testing.assert_allclose(written.of("hip_flexion_r"), np.degrees(motion.of("hip_flexion_r")), atol=1e-9)
    # The left knee and the arms have no task: like OpenSim they keep their default, and that is said.
    assert np.all(written.of("knee_angle_l") == 0.0)
    assert "knee_angle_l is seen by no marker: it keeps its default." in result.remarks


def test_scaling_of_a_setup(folder):
    model, result = run_scale(folder / "scale.xml")
    assert [file.name for file in result.files] == ["factors.xml", "scaled.osim", "static.mot", "placed.osim"]
    assert result.remarks == ("The model has no body patella_r: its scale factor is not used.",)
    assert model.name == "person"
    assert model.mass_kg == pytest.approx(61.5)
    assert "<scales>1.1 1.2 1.3</scales>" in (folder / "factors.xml").read_text()
    scaled, placed = read_osim(folder / "scaled.osim"), read_osim(folder / "placed.osim")
    generic = read_osim(BODY)
    thigh = generic.bodies.index("femur_r")
    ratio = scaled.bodies.com_body_m[thigh] / generic.bodies.com_body_m[thigh]
    np.testing.assert_allclose(ratio, 1.1, atol=1e-4)
    assert placed.mass_kg == pytest.approx(61.5)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("ik.xml", "0.1 0.5", "7 8", "walk.trc has no frame between 7 and 8 s: it runs from 0 to 1 s"),
        ("ik.xml", "0.1 0.5", "0.5 0.1", "<time_range>"),
        ("ik.xml", 'name="hip_r"', 'name="hop_r"', "hop_r, which the trial does not hold"),
        ("ik.xml", "lumbar_extension", "lumber", "no coordinate named lumber"),
        ("ik.xml", "body.osim", "nobody.osim", "nobody.osim can't be read"),
        ("ik.xml", "InverseKinematicsTool", "ScaleTool", "holds no InverseKinematicsTool"),
        ("scale.xml", "knee_r </markers>", "kneel_r </markers>", "no marker named kneel_r"),
        ("scale.xml", "<time_range>0 1<", "<time_range>3 4<", "no frame between 3 and 4 s"),
    ],
)
def test_what_is_wrong_with_a_setup_is_named(folder, file, old, new, message):
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message) as raised:
        (run_kinematics if file == "ik.xml" else run_scale)(folder / file)
    assert raised.value.hint


@pytest.mark.skipif(not EXAMPLE.is_dir(), reason="the Gait2354 example is read from ../shared/data")
def test_the_example_of_opensim_runs_unchanged(tmp_path):
    for path in EXAMPLE.glob("*.*"):
        shutil.copyfile(path, tmp_path / path.name)
    model, scaled = run_scale(tmp_path / "subject01_Setup_Scale.xml")
    assert model.mass_kg == pytest.approx(72.6)
    assert {file.name for file in scaled.files} >= {"subject01_simbody.osim", "subject01_scaleSet_applied.xml"}
    shutil.copyfile(EXAMPLE / "subject01_simbody.osim", tmp_path / "subject01_simbody.osim")  # compare on OpenSim's own
    motion, solved = run_kinematics(tmp_path / "subject01_Setup_IK.xml")
    assert solved.remarks == ()
    reference = read_mot(EXAMPLE / "OutputReference" / "subject01_walk1_ik.mot")
    written = read_mot(tmp_path / "subject01_walk1_ik.mot")
    assert written.labels == reference.labels
    assert len(written.times_s) == len(reference.times_s) == len(motion.times_s) == 73
    # OpenSim's own convergence error at its default accuracy is 0.11 degrees.
    assert np.abs(written.values - reference.values).max() < 0.15
