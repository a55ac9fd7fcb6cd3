"""The exponential map of rigid motions."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.geometry import se2
from torchcrf_scan.stream import twist

NUMBER = st.floats(-20, 20)
MOTION = st.tuples(st.floats(-3.1, 3.1), NUMBER, NUMBER)


def test_quarter_circle() -> None:
    """Ahead at pi / 2 m/s, turning by a quarter in one second: a circle of radius 1."""
    np.testing.assert_allclose(twist.exp(np.array([np.pi / 2, np.pi / 2, 0.0])), [np.pi / 2, 1.0, 1.0])


@given(MOTION)
def test_log_inverts_exp(motion: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(twist.exp(twist.log(np.array(motion))), motion, atol=1e-9)


@given(MOTION, st.floats(0, 1))
def test_parts_of_a_motion_make_the_whole(velocity: tuple[float, float, float], share: float) -> None:
    first, rest = twist.exp(share * np.array(velocity)), twist.exp((1 - share) * np.array(velocity))
    whole = twist.exp(np.array(velocity))
    np.testing.assert_allclose(se2.compose(first, rest)[1:], whole[1:], atol=1e-6)


@given(st.floats(-1e-5, 1e-5), NUMBER, NUMBER)
def test_nearly_straight(theta: float, x: float, y: float) -> None:
    np.testing.assert_allclose(twist.exp(np.array([theta, x, y])), [theta, x, y], atol=3e-4)
