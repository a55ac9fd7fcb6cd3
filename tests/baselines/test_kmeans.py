"""K-Means on displacements: outliers of the associating method (T9), groups by size, few and equal displacements."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from checks import check, same
from rooms import AWKWARD, room_pair

from torchcrf_scan.baselines.icp import match_icp
from torchcrf_scan.baselines.kmeans import cluster_displacements, fit_group, group_by_size
from torchcrf_scan.baselines.ransac import match_ransac
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import PairPrediction, ScanPair

TURNED = np.array([0.2, 0.0, 0.0])


def truly_matched(pair: ScanPair, motion: np.ndarray, moving: np.ndarray, shift: np.ndarray) -> tuple[ScanPair, PairPrediction]:
    """The pair whose target are the source's own points, moved, and the association i -> i."""
    ends = se2.apply(motion, pair.source.points + moving[:, None] * shift)
    bearings = np.arctan2(ends[:, 1], ends[:, 0])
    order = np.argsort(bearings)
    ranges, beam = np.linalg.norm(ends, axis=1)[order], pair.source.beam[order]
    target = replace(pair.source, ranges=ranges, bearings=bearings[order], beam=beam)
    identity = match_icp(ScanPair(pair.source, pair.source))
    return replace(pair, target=target), replace(identity, motions=motion[None])


@pytest.mark.parametrize("remove_motion", [False, True])
def test_associations_and_outliers_are_those_of_the_associating_method(remove_motion: bool) -> None:
    groups = []
    for pair in simulate_pairs(WORLDS["street"], 3, 1, 0):
        matched = match_icp(pair, gate=0.2)
        found = cluster_displacements(pair, matched, remove_motion=remove_motion)
        check(pair, found)
        assert found.association.tolist() == matched.association.tolist()
        ours, theirs = score_pair(pair, found), score_pair(pair, matched)
        assert ours.cluster.outliers_predicted == theirs.association.outliers_predicted == ours.association.outliers_predicted
        assert ours.cluster.outliers_both == theirs.association.outliers_both
        groups.append(len(found.motions))
        sizes = np.bincount(found.cluster[found.cluster >= 0])
        assert sizes[0] == sizes.max()
    assert max(groups) == 4  # the paper's K


def test_removing_the_motion_finds_the_box_where_turning_shatters_the_room() -> None:
    pair = room_pair(np.zeros(3), np.zeros(2))
    box = np.abs(pair.source.points - [2.4, -0.1]).max(1) < 0.6
    pair, matched = truly_matched(pair, TURNED, box, np.array([0.0, 0.8]))
    found = cluster_displacements(pair, matched, clusters=2, remove_motion=True)
    assert (found.cluster == box).all()
    assert np.allclose(found.motions[0], TURNED)
    ends = pair.target.to_beams(pair.target.points, np.nan)
    assert np.allclose(se2.apply(found.motions[1], pair.source.points[box]), ends[pair.source.beam[box]])
    shattered = cluster_displacements(pair, matched, clusters=2)
    assert np.mean(shattered.cluster[~box] == 0) < 0.9


def test_the_largest_group_is_the_background_whatever_it_does() -> None:
    pair = room_pair(np.zeros(3))
    first_third = np.arange(len(pair.source)) < len(pair.source) // 3
    pair, matched = truly_matched(pair, np.zeros(3), ~first_third, np.array([3.0, 0.0]))
    found = cluster_displacements(pair, matched, clusters=2)
    assert (found.cluster == first_third).all()
    assert np.allclose(found.motions, [[0, 3, 0], [0, 0, 0]], atol=1e-9)


def test_few_and_equal_displacements_make_fewer_groups() -> None:
    assert group_by_size(np.zeros((5, 2)), 4).tolist() == [0] * 5
    assert group_by_size(np.array([[0.0, 0.0]]), 4).tolist() == [0]
    assert group_by_size(np.array([[0.0, 0], [1, 0], [1, 0]]), 4).tolist() == [1, 0, 0]
    nearly = np.repeat([[0.0, 0.0], [1.0, 0.0]], 5, axis=0) + 1e-17 * np.arange(10)[:, None]
    assert set(group_by_size(nearly, 4).tolist()) >= {0, 1}


def test_groups_without_extent_take_the_rotation_given() -> None:
    p, shift = np.array([[1.0, 0.0], [1.0, 0.01], [1.01, 0.0]]), np.array([0.5, 0.0])
    motion = fit_group(p, p + shift, 0.1)
    assert motion[0] == 0.1
    assert np.allclose(se2.apply(motion, p).mean(0), p.mean(0) + shift)
    wide = p * 100
    assert np.allclose(fit_group(wide, se2.apply(TURNED, wide), 0.0), TURNED)
    assert fit_group(wide[:2], wide[:2], 0.1)[0] == 0.1


@pytest.mark.parametrize("names", list(itertools.product(AWKWARD, AWKWARD)))
def test_awkward_scans_get_a_defined_answer(names: tuple[str, str]) -> None:
    pair = ScanPair(*(AWKWARD[name] for name in names))
    for matched in (match_icp(pair), match_ransac(pair)):
        found = cluster_displacements(pair, matched)
        check(pair, found)
        assert found.association.tolist() == matched.association.tolist()


def test_no_associations_keep_the_motion() -> None:
    pair = room_pair(TURNED)
    matched = match_icp(pair)
    nothing = np.full(pair.source.n_beams, -1)
    found = cluster_displacements(pair, replace(matched, association=nothing, cluster=nothing))
    check(pair, found)
    assert found.motions.tolist() == matched.motions.tolist()


def test_the_same_answer_every_time() -> None:
    pair = simulate_pairs(WORLDS["street"], 1, 1, 0)[0]
    assert same(cluster_displacements(pair, match_icp(pair)), cluster_displacements(pair, match_icp(pair)))
