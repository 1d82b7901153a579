"""Thruster geometry and allocation."""

import numpy as np
import pytest
from scipy.optimize import linprog

from freeflyer_env import Robot
from freeflyer_env.robot import body_from_world

ROBOT = Robot()
# Sign of (F_x, F_y, M) of each thruster, from the drawing in freeflyer_env.robot.
SIGNS = [
    (0, -1, -1),
    (-1, 0, 1),
    (1, 0, -1),
    (0, -1, 1),
    (0, 1, -1),
    (1, 0, 1),
    (-1, 0, -1),
    (0, 1, 1),
]


@pytest.mark.parametrize("thruster", range(8))
def test_each_thrusters_wrench(thruster):
    expected = np.array(SIGNS[thruster]) * [0.2, 0.2, 0.2 * 0.11461]
    np.testing.assert_allclose(ROBOT.wrench_matrix[:, thruster], expected, atol=1e-12)


def test_thrusters_sit_on_the_rim():
    radii = np.linalg.norm(ROBOT.thruster_positions, axis=1)
    np.testing.assert_allclose(radii, ROBOT.radius)


def test_clusters_match_the_thrusters():
    clusters = np.random.default_rng(0).uniform(-1, 1, 4)
    duties = np.zeros(8)
    for (forward, backward), value in zip(((7, 0), (2, 1), (4, 3), (5, 6)), clusters):
        duties[forward if value > 0 else backward] = abs(value)
    wrench = ROBOT.cluster_matrix @ clusters * ROBOT.thrust
    np.testing.assert_allclose(ROBOT.wrench_matrix @ duties, wrench, atol=1e-12)
    np.testing.assert_allclose(ROBOT.cluster_matrix @ ROBOT.cluster_inverse, np.eye(3), atol=1e-12)


def test_every_realisable_wrench_is_met_exactly():
    duties = np.random.default_rng(1).uniform(0, 1, (500, 8))
    wrenches = duties @ ROBOT.wrench_matrix.T
    allocated = ROBOT.allocate(wrenches)
    assert allocated.min() >= 0.0
    assert allocated.max() <= 1.0
    np.testing.assert_allclose(allocated @ ROBOT.wrench_matrix.T, wrenches, atol=1e-12)


def test_no_other_allocation_needs_less_propellant():
    wrenches = np.random.default_rng(2).uniform(0, 1, (50, 8)) @ ROBOT.wrench_matrix.T
    for wrench, duties in zip(wrenches, ROBOT.allocate(wrenches)):
        least = linprog(np.ones(8), A_eq=ROBOT.wrench_matrix, b_eq=wrench, bounds=(0.0, 1.0))
        assert duties.sum() == pytest.approx(least.fun, abs=1e-7)


def test_beyond_reach_the_direction_is_kept():
    wrench = np.array([3.0, -1.0, 0.02])
    got = ROBOT.wrench_matrix @ ROBOT.allocate(wrench)
    np.testing.assert_allclose(got / np.linalg.norm(got), wrench / np.linalg.norm(wrench))
    assert np.linalg.norm(got) < np.linalg.norm(wrench)


def test_reach_is_one_at_full_thrust():
    dv = ROBOT.delta_v_max(0.5)
    assert ROBOT.reach(np.array([2 * dv, 0.0, 0.0]), 0.5) == pytest.approx(1.0)
    assert ROBOT.reach(np.array([0.0, 0.0, 4 * 0.11461 * dv]), 0.5) == pytest.approx(1.0)


def test_body_from_world():
    np.testing.assert_allclose(
        body_from_world(np.pi / 2, np.array([1.0, 0.0, 3.0])), [0.0, -1.0, 3.0], atol=1e-12
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0.0}, "Robot.mass must be a positive"),
        ({"inertia": float("nan")}, "Robot.inertia must be a positive"),
        ({"lever_arm": 0.2}, "at most the radius"),
    ],
)
def test_bad_robots(change, message):
    with pytest.raises(ValueError, match=message):
        Robot(**change)
