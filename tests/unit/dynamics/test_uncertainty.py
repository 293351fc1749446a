"""Error bars of a small body against the same sums written out over the whole trial."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import InputError
from gonio.formats.osim import read_osim
from gonio.kernel.dynamics import opensim, zero_lag
from gonio.kernel.dynamics.opensim import SmoothMotion
from gonio.kernel.dynamics.uncertainty import Smoother, lasting, propagate, white
from gonio.records import BodyModel

PENDULUM = """<OpenSimDocument Version="40000"><Model name="pendulum"><Ground name="ground"/><BodySet><objects>
<Body name="rod"><mass>2</mass><mass_center>0 -0.5 0</mass_center><inertia>0.1 0.1 0.1 0 0 0</inertia></Body>
<Body name="tip"><mass>1</mass><mass_center>0 -0.2 0</mass_center><inertia>0.02 0.02 0.02 0 0 0</inertia></Body></objects>
</BodySet><JointSet><objects>
<PinJoint name="a"><socket_parent_frame>/ground</socket_parent_frame><socket_child_frame>/bodyset/rod</socket_child_frame>
<coordinates><Coordinate name="swing"/></coordinates></PinJoint>
<PinJoint name="b"><socket_parent_frame>below</socket_parent_frame><socket_child_frame>/bodyset/tip</socket_child_frame>
<coordinates><Coordinate name="bend"/></coordinates><frames><PhysicalOffsetFrame name="below">
<socket_parent>/bodyset/rod</socket_parent><translation>0 -1 0</translation></PhysicalOffsetFrame></frames></PinJoint>
</objects></JointSet></Model></OpenSimDocument>"""
RATE_HZ, FRAMES = 60.0, 700  # more than two windows
TIMES_S = np.arange(FRAMES) / RATE_HZ


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> BodyModel:
    file: Path = tmp_path_factory.mktemp("pendulum") / "pendulum.osim"
    file.write_text(PENDULUM)
    return read_osim(file)


def swing(times_s: np.ndarray) -> np.ndarray:
    return np.stack([0.4 * np.sin(4 * times_s), 0.3 * np.cos(5 * times_s)], axis=1)


def constant(sd: np.ndarray, correlation: float = 0.3) -> np.ndarray:
    """Covariances of two coordinates with these standard deviations, (sample, 2)."""
    r = np.array([[1.0, correlation], [correlation, 1.0]])
    return r * sd[:, :, None] * sd[:, None, :]


SMOOTHERS: dict[str, Smoother] = {
    "opensim": lambda times_s, values: opensim.differentiate(times_s, values, 6.0),
    "zero_lag": lambda times_s, values: zero_lag.differentiate(times_s, values, 6.0),
    "unfiltered": lambda times_s, values: zero_lag.differentiate(times_s, values, None),
}


@pytest.mark.parametrize("way", SMOOTHERS)
@pytest.mark.parametrize("correlation", [white, lasting(0.08)])
def test_bars_are_the_sums_over_the_whole_trial(model: BodyModel, way: str, correlation: Callable) -> None:
    """All impulses through the whole trial at once: no windows, nothing left out."""
    smoother = SMOOTHERS[way]
    sd = np.stack([0.02 + 0.01 * np.sin(TIMES_S), np.where((TIMES_S > 3) & (TIMES_S < 4), 0.05, 0.01)], axis=1)
    bars = propagate(model, smoother(TIMES_S, swing(TIMES_S)), smoother, TIMES_S, constant(sd), correlation=correlation)
    S = smoother(TIMES_S, np.eye(FRAMES)).q
    rho = correlation(TIMES_S[:, None] - TIMES_S)
    for coordinate in range(2):
        weighed = S * sd[:, coordinate]
        expected = np.sqrt(np.einsum("fk,kl,fl->f", weighed, rho, weighed, optimize=True))
        np.testing.assert_allclose(bars.q[:, coordinate], expected, rtol=1e-4)


def test_torques_of_a_still_pendulum_follow_by_hand(model: BodyModel) -> None:
    """Hanging down at rest: δτ = K δq + M δq̈, with K and M of a double pendulum from any textbook."""
    smoother = SMOOTHERS["zero_lag"]
    still, sd = np.zeros((FRAMES, 2)), np.full((FRAMES, 2), 0.01)
    bars = propagate(model, smoother(TIMES_S, still), smoother, TIMES_S, constant(sd))
    motion = smoother(TIMES_S, np.eye(FRAMES))
    g = 9.80665
    K = g * np.array([[2 * 0.5 + 1 * 1.2, 0.2], [0.2, 0.2]])
    outer = 0.02 + 0.2**2
    M = np.array([[0.1 + 2 * 0.5**2 + 0.02 + 1.2**2, outer + 0.2], [outer + 0.2, outer]])
    C = constant(sd)[0]
    middle = FRAMES // 2
    s0, s2 = motion.q[middle], motion.acceleration[middle]
    expected = (s0 @ s0) * K @ C @ K.T + (s2 @ s2) * M @ C @ M.T + (s0 @ s2) * (K @ C @ M.T + M @ C @ K.T)
    np.testing.assert_allclose(bars.forces[middle], np.sqrt(np.diag(expected)), rtol=1e-5)


def test_a_part_of_the_trial_has_the_bars_that_it_has_in_the_whole(model: BodyModel) -> None:
    sd, motion = np.full((FRAMES, 2), 0.02), swing(TIMES_S)
    whole_of, part_of = (
        partial(zero_lag.differentiate, cutoff_hz=6.0, time_range_s=span) for span in ((-np.inf, np.inf), (4.0, 5.0))
    )
    whole = propagate(model, whole_of(TIMES_S, motion), whole_of, TIMES_S, constant(sd))
    part = propagate(model, part_of(TIMES_S, motion), part_of, TIMES_S, constant(sd))
    assert len(part.q) == 61
    np.testing.assert_allclose(part.forces, whole.forces[240:301], rtol=1e-6)


def test_uneven_times_have_bars_too(model: BodyModel) -> None:
    """OpenSim resamples times that were rounded to milliseconds: the clock changes, the bars hardly do."""
    smoother, sd = SMOOTHERS["opensim"], np.full((FRAMES, 2), 0.02)
    rounded = np.round(TIMES_S, 3)
    motion = smoother(rounded, swing(rounded))
    assert len(motion.times_s) > FRAMES
    bars = propagate(model, motion, smoother, rounded, constant(sd))
    even = propagate(model, smoother(TIMES_S, swing(TIMES_S)), smoother, TIMES_S, constant(sd))
    # Measured: 0.03 % in the positions and 0.2 % in the torques, since 0.0166 s is not quite a sixtieth.
    np.testing.assert_allclose(np.median(bars.q, axis=0), np.median(even.q, axis=0), rtol=0.01)
    np.testing.assert_allclose(np.median(bars.forces, axis=0), np.median(even.forces, axis=0), rtol=0.01)


def test_what_is_not_known_has_no_bars_and_what_it_has_no_part_in_has(model: BodyModel) -> None:
    smoother, covariance = SMOOTHERS["zero_lag"], constant(np.full((FRAMES, 2), 0.02))
    covariance[300:310, 1] = covariance[300:310, :, 1] = np.nan
    bars = propagate(model, smoother(TIMES_S, swing(TIMES_S)), smoother, TIMES_S, covariance)
    assert np.isfinite(bars.q[:, 0]).all()
    assert np.isnan(bars.q[298:312, 1]).all()
    assert np.isnan(bars.forces[298:312]).all()  # both torques depend on the bend
    assert np.isfinite(bars.forces[:270]).all()
    assert np.isfinite(bars.forces[340:]).all()


def test_what_is_known_exactly_has_bars_of_zero(model: BodyModel) -> None:
    smoother = SMOOTHERS["zero_lag"]
    bars = propagate(model, smoother(TIMES_S, swing(TIMES_S)), smoother, TIMES_S, np.zeros((FRAMES, 2, 2)))
    assert not bars.q.any()
    assert not bars.forces.any()


def test_covariances_of_another_trial_are_refused(model: BodyModel) -> None:
    smoother = SMOOTHERS["zero_lag"]
    motion: SmoothMotion = smoother(TIMES_S, swing(TIMES_S))
    with pytest.raises(InputError, match="700 samples of 2 coordinates"):
        propagate(model, motion, smoother, TIMES_S, np.zeros((3, 2, 2)))
