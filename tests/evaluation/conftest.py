import pytest
from made_causes import Street, make_street
from made_pairs import make_small

from torchcrf_scan.scan import ScanPair


@pytest.fixture
def street() -> Street:
    return make_street()


@pytest.fixture
def small() -> ScanPair:
    return make_small()
