"""Norms: what the cards hold, and how far a walk is from them."""

import csv
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.norms import builtin_norms, builtin_usual_values, read_norms, read_usual_values
from gonio.kernel.gait.norms import condition_at, dimensionless_speed, gait_variable_score, profile_score


def test_the_shipped_curves_are_those_of_healthy_walking() -> None:
    for norms in builtin_norms():
        assert "(20" in norms.citation
        assert norms.licence
        for condition in norms.conditions:
            knee = condition.curves["knee_flexion"]
            # Extended at contact, bent in loading, extended in mid-stance, bent by about 60° in swing.
            assert knee.mean[0] < knee.mean[15] > knee.mean[40]
            assert 55 < knee.mean.max() < 68
            assert 65 < np.argmax(knee.mean) < 78
            assert all((curve.sd > 0).all() for curve in condition.curves.values())
    children = builtin_norms()[1]
    moment = condition_at(children, 0.43).curves["knee_extension_moment"]
    assert moment.unit == "Nm/kg"
    assert 5 < np.argmax(moment.mean) < 20
    assert np.abs(moment.mean[62:85]).max() < 0.15


def test_a_card_with_51_points_passes_through_them(tmp_path: Path) -> None:
    card = tmp_path / "own.toml"
    values = [float(i**2) for i in range(51)]
    card.write_text(
        f"name = 'own'\npopulation = 'a lab'\ncitation = 'here'\nlicence = 'own'\n[[conditions]]\nname = 'free'\n"
        f"dimensionless_speed = [0, 1]\n[conditions.curves.knee_flexion]\nunit = 'deg'\nmean = {values}\nsd = {[1.0] * 51}\n"
    )
    curve = read_norms(card).conditions[0].curves["knee_flexion"]
    np.testing.assert_allclose(curve.mean[::2], values)
    assert curve.mean[1] == pytest.approx(0.5)


@pytest.mark.parametrize(
    "text",
    [
        "name = 'x'",
        "not toml",
        "name='x'\npopulation=''\ncitation=''\nlicence=''\n[[conditions]]\nname='a'\ndimensionless_speed=[0]\n",
        "name='x'\npopulation=''\ncitation=''\nlicence=''\n[[conditions]]\nname='a'\ndimensionless_speed=[0,1]\n"
        "[conditions.curves.knee]\nunit='deg'\nmean=[1,2]\nsd=[1]\n",
    ],
)
def test_a_wrong_card_is_refused_by_name(tmp_path: Path, text: str) -> None:
    card = tmp_path / "wrong.toml"
    card.write_text(text)
    with pytest.raises(InputError, match=r"wrong\.toml"):
        read_norms(card)
    with pytest.raises(InputError, match=r"wrong\.toml"):
        read_usual_values(card)


def test_usual_values_differ_by_sex_where_they_do() -> None:
    usual = builtin_usual_values()
    assert usual.male["speed"] > usual.female["speed"]
    assert usual.male["stance"] == usual.female["stance"]


def test_the_speed_chooses_the_condition() -> None:
    children = builtin_norms()[1]
    # 1.0 m/s on legs of 0.8 m: 1 / √(9.81 · 0.8) = 0.357
    assert condition_at(children, dimensionless_speed(1.0, 0.8)).name == "slow"
    assert condition_at(children, dimensionless_speed(1.2, 0.8)).name == "free"
    assert condition_at(children, 0.8).name == "fast"
    assert condition_at(children, float("nan")).name == "free"


def test_scores_are_root_mean_squares() -> None:
    norm = np.zeros(101)
    curve = np.full(101, 3.0)
    curve[:10] = np.nan
    assert gait_variable_score(curve, norm) == pytest.approx(3.0)
    assert np.isnan(gait_variable_score(np.full(101, np.nan), norm))
    assert profile_score([3.0, 4.0, float("nan")]) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(profile_score([]))


def test_the_shipped_curves_are_the_published_ones(normative: Path) -> None:
    adults, children = builtin_norms()
    with (normative / "angles_adult_Fukuchi2018_treadmill_1.26mps.csv").open() as file:
        rows = list(csv.DictReader(file))
    for quantity, curve in adults.conditions[0].curves.items():
        for statistic in ("mean", "sd"):
            published = [float(row[f"{quantity}_deg_{statistic}"]) for row in rows]
            np.testing.assert_allclose(getattr(curve, statistic)[::2], published, atol=1e-9)
    with (normative / "normative_all_long.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["source"] == "Schwartz2008" and row["axis_XYZ"] == "X"]
    labels = {"flexion": "Angles", "dorsiflexion": "Angles", "moment": "Moment"}
    for condition in children.conditions:
        for quantity, curve in condition.curves.items():
            joint, _, what = quantity.partition("_")
            label = joint.capitalize() + labels[what.rpartition("_")[2]]
            own = [row for row in rows if (row["condition"], row["label"]) == (condition.name, label)]
            # The cards keep three digits.
            np.testing.assert_allclose(curve.mean[::2], [float(row["mean"]) for row in own], atol=6e-4)
            np.testing.assert_allclose(curve.sd[::2], [float(row["sd"]) for row in own], atol=6e-4)
