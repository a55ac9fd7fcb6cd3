"""Data association, motion clustering and motion estimation between two planar laser scans by a conditional random field.

Dimensions: B pairs, N source points, M target points, K candidates per point, S = K+1 association states (last = outlier),
D clusters (0 background, 1..D-2 movers, last = outlier; files store outliers as -1), F features, E edges. Batch first; masks
are bool, True = real; log-domain quantities are named `log_*`. Frame: x ahead, y left, metres, radians, seconds;
`T_target_source` = (theta, tx, ty) maps points of the first scan (source) into the frame of the second (target).
"""

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.features.learned import ExtraLogUnary
from torchcrf_scan.model import ClusteringCRF, JointScanCRF, MatchingCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair
from torchcrf_scan.stream.config import StreamConfig
from torchcrf_scan.stream.stream import ScanStream

__version__ = "1.0.0"

__all__ = [
    "Annotation",
    "ClusteringCRF",
    "ExtraLogUnary",
    "FeatureConfig",
    "InferenceConfig",
    "JointScanCRF",
    "MatchingCRF",
    "ModelConfig",
    "MovingObject",
    "PairPrediction",
    "Prediction",
    "Scan",
    "ScanPair",
    "ScanPairBatch",
    "ScanResult",
    "ScanStream",
    "StreamConfig",
    "TorchCRFScanError",
    "__version__",
]
