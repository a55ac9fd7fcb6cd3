"""Other people's registrations: run where installed, and the bridge to them with a stand-in where not."""

import itertools
import math
import sys
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from checks import check
from rooms import AWKWARD, room_pair

from torchcrf_scan.baselines import register
from torchcrf_scan.baselines.libraries import match_open3d, match_small_gicp, planar_motion
from torchcrf_scan.baselines.register import BASELINES, can_import, installed
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import PairPrediction, ScanPair

MOTION = np.array([0.03, 0.1, -0.08])


def transform(motion: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[math.cos(motion[0]), -math.sin(motion[0])], [math.sin(motion[0]), math.cos(motion[0])]]
    T[:2, 3] = motion[1:]
    return T


@pytest.fixture(params=[("small_gicp", match_small_gicp), ("open3d", match_open3d)], ids=lambda of: of[0])
def method(request: pytest.FixtureRequest) -> Callable[[ScanPair], PairPrediction]:
    module, match = request.param
    if not can_import(module):
        pytest.skip(f"needs {module}: pip install torchcrf-scan[bench]")
    return match


def test_a_small_motion_is_recovered(method: Callable[[ScanPair], PairPrediction]) -> None:
    pair = room_pair(MOTION)
    found = method(pair)
    check(pair, found)
    turn, shift = se2.distance(found.motions[0], MOTION)
    assert turn < 0.01
    assert shift < 0.05


def test_awkward_scans_get_a_defined_answer_from_a_library(method: Callable[[ScanPair], PairPrediction]) -> None:
    for source, target in itertools.product(AWKWARD.values(), AWKWARD.values()):
        pair = ScanPair(source, target)
        check(pair, method(pair))


def test_planar_motion_of_a_transform() -> None:
    assert np.allclose(planar_motion(transform(MOTION)), MOTION)


def test_only_what_can_be_imported_is_offered(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(module: str) -> None:
        if module != "small_gicp":
            raise ModuleNotFoundError(module)

    monkeypatch.setattr(register, "import_module", find)
    assert set(BASELINES) - set(installed()) == {"Open3D (ICP)"}


def test_the_clouds_and_the_motion_go_the_right_way(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = room_pair(MOTION)
    seen = {}

    def align(target: np.ndarray, source: np.ndarray, **options: object) -> SimpleNamespace:
        seen.update(options, target=target, source=source)
        return SimpleNamespace(T_target_source=transform(MOTION))

    monkeypatch.setitem(sys.modules, "small_gicp", SimpleNamespace(PointCloud=lambda points: points, align=align))
    found = match_small_gicp(pair)
    check(pair, found)
    assert np.allclose(found.motions, [MOTION])
    assert np.allclose(seen["source"][:, :2], pair.source.points)
    assert np.allclose(seen["target"][:, :2], pair.target.points)
    assert (seen["source"][:, 2] == 0).all()
    assert seen["registration_type"] == "ICP"
    assert np.mean(found.association >= 0) > 0.9
