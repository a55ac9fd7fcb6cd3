"""The oracles against numbers worked out by hand."""

import math

import numpy as np
import oracles
import pytest

# Two nodes of two states: scores 00 -> 1+0+2, 01 -> 1+3+0, 10 -> 0+0+2, 11 -> 0-1+0.
UNARY = np.array([[1.0, 0.0], [2.0, 0.0]])
PAIRWISE = np.array([[[0.0, 3.0], [0.0, -1.0]]])
LOG_Z = math.log(math.exp(3) + math.exp(4) + math.exp(2) + math.exp(-1))

CORNER = np.array([[2.0, 0.0], [2.0, 1.0], [1.0, 1.0], [0.0, 1.0]])  # a right angle seen from inside


def test_scores_of_all_labellings() -> None:
    assert [oracles.score(UNARY, PAIRWISE, labels) for labels in oracles.labellings(UNARY)] == [3.0, 4.0, 2.0, -1.0]
    assert oracles.best_labelling(UNARY, PAIRWISE) == (0, 1)


def test_log_partition() -> None:
    assert oracles.log_partition(UNARY, PAIRWISE) == pytest.approx(LOG_Z)
    assert oracles.log_partition(UNARY, PAIRWISE, 0) == 4.0
    halved = 0.5 * math.log(math.exp(6) + math.exp(8) + math.exp(4) + math.exp(-2))
    assert oracles.log_partition(UNARY, PAIRWISE, 0.5) == pytest.approx(halved)


def test_marginals() -> None:
    first = math.log(math.exp(3) + math.exp(4)) - LOG_Z
    second = math.log(math.exp(3) + math.exp(2)) - LOG_Z
    marginals = oracles.log_marginals(UNARY, PAIRWISE)
    assert marginals[:, 0] == pytest.approx([first, second])
    assert np.exp(marginals).sum(axis=1) == pytest.approx([1.0, 1.0])


def test_max_marginals() -> None:
    best = oracles.log_marginals(UNARY, PAIRWISE, 0)  # first node 4 and 2, second node 3 and 4
    assert best[:, 0] - best[:, 1] == pytest.approx([2.0, -1.0])


def test_impossible_states() -> None:
    unary = np.array([[-np.inf, 0.0], [2.0, 0.0]])
    assert oracles.log_partition(unary, PAIRWISE) == pytest.approx(math.log(math.exp(2) + math.exp(-1)))
    assert oracles.log_marginals(unary, PAIRWISE)[0].tolist() == pytest.approx([-math.inf, 0.0])
    assert oracles.log_sum_exp([-math.inf, -math.inf]) == -math.inf


def test_the_relaxation_is_tight_on_a_tree_and_loose_on_a_circle() -> None:
    assert oracles.relaxed_best(list(UNARY), oracles.chain_edges(PAIRWISE)) == pytest.approx(4.0)
    none, differ = [np.zeros(2)] * 3, 1.0 - np.eye(2)  # two of three neighbours on a circle are alike, but half of each is not
    assert oracles.relaxed_best(none, {(0, 1): differ, (1, 2): differ}) == pytest.approx(2.0)
    assert oracles.relaxed_best(none, {(0, 1): differ, (1, 2): differ, (2, 0): differ}) == pytest.approx(3.0)
    impossible = [np.array([0.0, -np.inf]), np.zeros(2), np.array([0.0, -np.inf])]
    assert oracles.relaxed_best(impossible, {(0, 1): differ, (1, 2): differ, (2, 0): differ}) == pytest.approx(2.0)


def test_motion_and_angle() -> None:
    assert oracles.move((math.pi / 2, 1.0, 2.0), (3.0, 0.0)) == pytest.approx((1.0, 5.0))
    assert oracles.wrap(3 * math.pi / 2) == pytest.approx(-math.pi / 2)
    assert oracles.wrap(-math.pi) == pytest.approx(math.pi)
    assert oracles.fit_cost((0.0, 1.0, 0.0), np.zeros((2, 2)), np.array([[1.0, 2.0], [0.0, 0.0]]), [1.0, 3.0]) == 4.0 + 3.0


def test_robust_square() -> None:
    assert oracles.robust(0.2, 0.1) == pytest.approx(-4.0)
    assert oracles.robust(-5.0, 0.1) == -9.0


def test_neighbours_clamp_or_wrap() -> None:
    assert [oracles.neighbour(i, 3, 4, False) for i in range(4)] == [3, 3, 3, 3]
    assert [oracles.neighbour(i, -3, 4, True) for i in range(4)] == [1, 2, 3, 0]


def test_shape_of_a_corner() -> None:
    assert oracles.distance_to(CORNER, 0, 3, False) == pytest.approx(math.sqrt(5))
    assert oracles.geodesic_to(CORNER, 0, 3, False) == 3.0
    assert oracles.geodesic_to(CORNER, 0, 5, False) == 3.0  # clamped at the last point
    assert oracles.geodesic_to(CORNER, 1, -3, False) == 1.0
    assert oracles.geodesic_to(CORNER, 3, 1, True) == pytest.approx(math.sqrt(5))  # the last point leads to the first
    # u = (0, -1), v = (-1, 0): u x v = -1, so three quarters of a turn; from the other side of the wall a quarter
    assert oracles.angle_between(CORNER, 1, 1, False) == pytest.approx(3 * math.pi / 2)
    assert oracles.angle_between(CORNER[::-1], 2, 1, False) == pytest.approx(math.pi / 2)
    assert oracles.angle_between(CORNER, 2, 1, False) == pytest.approx(math.pi)
    assert oracles.angle_between(CORNER, 0, 1, False) == math.pi  # no arm before the first point


def test_local_association() -> None:
    source, target = CORNER[:2], np.array([[2.0, 0.0], [2.0, 1.5]])
    out = oracles.local_association(source, target, [1.0] * 12, (0.0, 0.5, 0.0), source + np.array([0.0, 0.25]))
    assert out.shape == (2, 2, 12)
    assert out[0, 0, 0] == pytest.approx(-0.125)  # after: 1 - 1.5, before: 0 - 0, the mean of the squares
    assert out[0, 1, 0] == pytest.approx(-(1.0 + 2.25) / 2)  # after: 1 - 0, before: 0 - 1.5
    assert out[0, 0, 3:6].tolist() == [0.0, 0.0, 0.0]  # two points: straight everywhere
    assert np.array_equal(out[..., 0], out[..., 6])
    assert out[1, 0, 9] == pytest.approx(-((math.sqrt(5) - 2) ** 2))
    assert out[1, 1, 10] == pytest.approx(-(0.25 + 0.25))  # (2.5, 1) to (2, 1.5)
    assert out[1, 1, 11] == pytest.approx(-0.0625)  # (2, 1.25) to (2, 1.5)


def test_pairwise_association() -> None:
    source, target = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 2.0]])
    out = oracles.pairwise_association(source, target, [1.0, 2.0], [-0.5, -0.25])
    assert out.shape == (1, 3, 3, 4)
    assert out[0, 0, 1].tolist() == pytest.approx([1, 0, -1, -5 / 4])  # d1 = 1, d2 = 2, |v1 - v2| = sqrt 5
    assert out[0, 1, 0].tolist() == pytest.approx([0, 0, -1, -5 / 4])
    assert out[0, 0, 0].tolist() == pytest.approx([0, 0, -1, -1 / 4])
    assert out[0, 0, 2].tolist() == out[0, 2, 1].tolist() == [0, 1, -0.5, -0.25]
    assert out[0, 2, 2].tolist() == [0, 0, -0.5, -0.25]


# One motion stays, the other goes 1 m to the left; the second point has no association.
POINTS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
PARTNERS = np.array([[0.0, 1.0], [1.0, 0.5]])
MOTIONS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def test_local_clustering() -> None:
    out = oracles.local_clustering(POINTS, PARTNERS, MOTIONS, [True, False], [0, -1, 1], 1.0, 0.6)
    assert out.shape == (3, 3, 4)
    assert out[0].tolist() == [[-1, 0, 1, 0], [0, 0, 1, 0], [0, 1, 0, 0]]  # residuals 1 (active) and 0 (not)
    assert out[1].tolist() == [[-0.25, 0, 0, 0], [-0.25, 0, 0, 0], [0, 0, 0, 1]]  # the nearest is 0.5 away both times
    assert out[2].tolist() == [[-0.25, 0, 1, 0], [-2.25, 0, 1, 0], [0, 0, 0, 0]]
    nobody = oracles.local_clustering(POINTS, PARTNERS, MOTIONS, [False, False], [0, -1, 1], 1.0, 0.6)
    assert nobody[:, 2, 1].tolist() == [1, 1, 1]


def test_pairwise_clustering() -> None:
    out = oracles.pairwise_clustering(POINTS[[0, 2]], PARTNERS, MOTIONS, [0, 1], 2.0, 1.0)
    d1, d2 = math.sqrt(2), math.sqrt(1.25)
    near, stiff = math.exp(-0.5), math.exp(-((d2 - d1) ** 2))
    assert out.shape == (1, 3, 3, 8)
    for k in (0, 1):
        assert out[0, k, k].tolist() == pytest.approx([1, near, 0, stiff, 0, -((d2 - d1) ** 2), 0, 0])
    assert out[0, 0, 1].tolist() == pytest.approx([0, 0, 1 - near, 0, 1 - stiff, 0, -((math.sqrt(5) - d1) ** 2), 0])
    assert out[0, 1, 0].tolist() == pytest.approx([0, 0, 1 - near, 0, 1 - stiff, 0, -((1 - d1) ** 2), 0])
    assert out[0, 2, 2].tolist() == [1] + [0] * 7
    assert out[0, 2, 0].tolist() == out[0, 1, 2].tolist() == [0] * 7 + [1]


def test_pairwise_clustering_needs_both_associations() -> None:
    out = oracles.pairwise_clustering(POINTS[[0, 2]], PARTNERS, MOTIONS, [0, -1], 2.0, 1.0)
    assert not out[..., 3:6].any()
    assert out[0, 0, 0, 1] == pytest.approx(math.exp(-0.5))
    assert out[0, 1, 0, 6] == pytest.approx(-((1 - math.sqrt(2)) ** 2))


def test_stump_sum() -> None:
    stumps = ([0, 1, 0], [0.5, 2.0, 0.0], [-1.0, 0.25, 3.0], [1.0, -0.25, 5.0])
    assert oracles.stump_sum([0.5, 2.5], *stumps) == -1.0 - 0.25 + 5.0
    assert oracles.stump_sum([0.75, 2.0], *stumps) == 1.0 + 0.25 + 5.0


def test_lattice_tables() -> None:
    unary = np.array([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 8.0]]])
    association = np.arange(12.0).reshape(1, 2, 2, 3)
    cluster = np.array([[[0.0, 100.0], [200.0, 300.0]]])
    nodes, edges = oracles.lattice_tables(unary, association, cluster)
    assert nodes.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert edges[0, 0, 2] == 3  # (0, 0) -> (1, 0): one cluster
    assert edges[0, 0, 3] == 5 + 100  # (0, 0) -> (1, outlier)
    assert edges[0, 3, 1] == 8 + 300  # (1, outlier) -> (0, outlier) touches it too
    wider = oracles.lattice_tables(np.zeros((2, 2, 3)), association, np.zeros((1, 3, 3)))[1]
    assert wider[0, 0, 1] == 1  # (0, 0) -> (0, 1): two clusters


SCALES = {
    **{"local": [1.0] * 12, "local_outlier": [-4.0] * 12, "pairwise": [1.0, 1.0], "pairwise_outlier": [-0.5, -0.25]},
    **{"cluster_distance": 0.5, "outlier_threshold": 0.6, "neighbour_weight": 2.0, "neighbour_distance": 1.0},
}


def test_look() -> None:
    wall = ([(2.0, -0.2), (2.0, 0.0), (2.0, 0.2)], (0.0, 0.0), False, 0.0)
    assert oracles.look(wall, (1.0, 0.05)) == (1, 0)
    assert oracles.look(wall, (2.0, 0.05)) == (0, 0)
    assert oracles.look(wall, (9.0, 0.05)) == (0, 1)
    assert oracles.look(wall, (-1.0, 0.0)) == (0, 1)  # nobody looks there
    step = math.atan2(0.2, 2.0)
    slack = 1.6 * (3 * step + 0.02)
    assert oracles.look(wall, (1.6, 0.0))[0] == pytest.approx(max(0.4 / slack - 1, 0))
    ring = ([(2.0, 0.0), (0.0, 2.0), (-2.0, 0.0), (0.0, -2.0)], (0.0, 0.0), True, 0.0)
    assert oracles.look(ring, (0.1, -0.1)) == (1, 0)
    assert oracles.look(([], (0.0, 0.0), False, 0.0), (1.0, 0.0)) == (0, 0)
    moved = ([(p[0] + 5, p[1]) for p in wall[0]], (5.0, 0.0), False, 0.0)
    assert oracles.look(moved, (6.0, 0.05)) == (1, 0)


def test_extensions_of_a_point() -> None:
    found = oracles.association_extension([0.1, 0.3, 9.0], [False, True, True], (0.5, 0.25), 0.5, 0.3)
    assert found[0, 0] == 0
    assert found[1].tolist() == [0, -0.5, 0, 0, 0]
    assert found[2].tolist() == pytest.approx([-3, -1, 0, 0, 0])
    assert found[3].tolist() == [0, 0, 1, 0.5, 0.25]
    ahead, back = [(0.1, 0.2), (0.3, 0.4)], [(0.5, 0.6), (0.7, 0.8)]
    partnered, alone = (oracles.clustering_extension([0.3, 9.0], ahead, back, 0.3, inlier, [0.0, 2.0]) for inlier in (True, False))
    assert partnered[0].tolist() == [-0.5, 0, -0.1, -0.5, -0.2, -0.6, 0, 0, 0]
    assert alone[1].tolist() == pytest.approx([-1, 0, -0.3, 0, -0.4, 0, 0, 0, -4])
    assert partnered[2].tolist() == alone[2].tolist() == [0, 1, 0, 0, 0, 0, 0.1, 0.2, 0]
    assert oracles.invert((math.pi / 2, 1.0, 0.0), (1.0, 3.0)) == pytest.approx((3, 0))


def test_lattice_local() -> None:
    data, outlier = ([11], [-0.5], [-1.0], [1.0]), ([11], [-0.5], [2.0], [3.0])
    possible = np.array([[True, True], [True, False], [True, True]])
    out = oracles.lattice_local(POINTS, PARTNERS, MOTIONS, possible, SCALES, (0.0, 0.0, 0.0), data, outlier)
    assert out.shape == (3, 9, 30)
    inlier, out_of_cluster, out_of_both = out[0, 0 * 3 + 1], out[0, 0 * 3 + 2], out[0, 8]
    assert inlier[[11, 12, 18, 20]].tolist() == [0, 1, 0, 1]  # (0, 0) moved up meets its candidate
    assert out[0, 0, [11, 12, 18]].tolist() == [-1, -1, -4]  # and not where it stays
    assert out_of_cluster[[11, 12, 18, 19, 20, 21]].tolist() == [0, 1, 0, 0, 0, 0]  # the better of both, but no cluster
    assert out_of_both[[11, 12, 13, 18, 19, 21]].tolist() == [-4, 0, 3, 0, 0, 1]
    assert out[1, 2, 11] == pytest.approx(-2)  # without the second motion (1, 0) is sqrt 2 from (0, 1)
    assert not out[..., 14:18].any()
    assert not out[..., 22:].any()


def test_lattice_pairwise() -> None:
    out = oracles.lattice_pairwise(POINTS[[0, 2]], PARTNERS, MOTIONS, SCALES)
    assert out.shape == (1, 9, 9, 30)
    inliers = oracles.pairwise_clustering(POINTS[[0, 2]], PARTNERS, MOTIONS, [0, 1], 2.0, 1.0)[0, 0, 1]
    assert out[0, 0, 3 + 1, 22:].tolist() == pytest.approx(inliers.tolist())
    assert out[0, 0, 3 + 1, 14] == 1  # candidate 0, then 1
    assert out[0, 0, 8, 14:18].tolist() == [0, 1, -0.5, -0.25]
    assert out[0, 0, 8, 22:].tolist() == [0] * 7 + [1]
    assert not out[0, 0, 6 + 1, 25:28].any()  # no association, no stretch
