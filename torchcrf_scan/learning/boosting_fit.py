"""AdaBoost over decision stumps, fitted by scikit-learn and converted to tables (spec 2.2, 2.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.features import association
from torchcrf_scan.features.boosting import StumpEnsemble
from torchcrf_scan.features.candidates import squared_distances
from torchcrf_scan.features.potentials import OUTLIER_INPUTS, AssociationStates, Boosters, PairView, find_candidates
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.pseudo_likelihood import PlugIns
from torchcrf_scan.learning.scales_fit import own_motion
from torchcrf_scan.names import LOCAL_CHANNELS, STATIC_CHANNELS

NEAREST = 15


def fit_stumps(inputs: np.ndarray, positive: np.ndarray, stumps: int) -> StumpEnsemble:
    """Discrete AdaBoost on class-balanced examples.

    Args:
        inputs: (P, F) float32. positive: (P,) bool. stumps: maximum number; fewer if a split is perfect.

    Returns:
        The ensemble, H = decision_function * sum of estimator weights / 4 (scikit-learn's weights are twice AdaBoost's alpha and
        its decision function is 2 H over their sum); the zero ensemble if one class is missing.
    """
    from sklearn.ensemble import AdaBoostClassifier
    from sklearn.tree import DecisionTreeClassifier

    ensemble = StumpEnsemble(inputs.shape[1], stumps)
    if positive.all() or not positive.any():
        return ensemble
    balance = np.where(positive, 0.5 / positive.sum(), 0.5 / (~positive).sum())
    fitted = AdaBoostClassifier(DecisionTreeClassifier(max_depth=1), n_estimators=stumps, random_state=0)
    fitted.fit(inputs, positive, sample_weight=balance)
    alphas = np.minimum(fitted.estimator_weights_, 2 * np.log(1e6)) / 2  # a perfect stump's weight is capped (spec 2.2)
    rows = [stump_of(tree.tree_) for tree in fitted.estimators_]
    feature, threshold, left, right = (torch.tensor(column) for column in zip(*rows, strict=True))
    alpha = torch.from_numpy(alphas[: len(rows)])
    ensemble.set_stumps(feature, threshold, left * alpha, right * alpha)
    return ensemble


def stump_of(tree: object) -> tuple[int, float, float, float]:
    """(feature, threshold, left sign, right sign); both signs are equal for a tree without a split.

    The threshold is rounded down to float32, which splits float32 inputs exactly as the float64 one does.
    """
    sign = np.where(tree.value[:, 0, 1] > tree.value[:, 0, 0], 1.0, -1.0)  # type: ignore[attr-defined]
    if tree.node_count == 1:  # type: ignore[attr-defined]
        return 0, 0.0, float(sign[0]), float(sign[0])
    exact = tree.threshold[0]  # type: ignore[attr-defined]
    rounded = np.float32(exact)
    if rounded > exact:
        rounded = np.nextafter(rounded, np.float32(-np.inf))
    left, right = tree.children_left[0], tree.children_right[0]  # type: ignore[attr-defined]
    return int(tree.feature[0]), float(rounded), float(sign[left]), float(sign[right])  # type: ignore[attr-defined]


def data_examples(
    view: PairView, plugins: PlugIns, scales: Scales, negatives: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Pairs of points: the true one of every inlier, and wrong ones as in `sample_targets` (spec 2.2).

    Returns:
        (P, 12) local channels and (P,) bool.
    """
    batch = view.batch
    assert batch.truth is not None
    truth = batch.truth.association
    moved = own_motion(plugins, batch.source)
    index, is_usable = sample_targets(truth, moved, batch.target, batch.target_mask, negatives, generator)
    index = torch.cat([truth.clamp(min=0)[..., None], index], dim=-1)  # the true one first
    is_usable = torch.cat([(truth >= 0)[..., None], is_usable], dim=-1)
    states = AssociationStates.of(view, index, is_usable, scales, Boosters(1))
    registered = association.registered_feature(moved, batch.target, index, scales)
    channels = torch.cat([states.static, registered[..., None]], dim=-1)  # (B, N, 1 + negatives, 12)
    chosen = is_usable & (plugins.known & batch.truth.known & batch.source_mask)[..., None]
    positive = torch.zeros_like(chosen)
    positive[..., 0] = True
    return channels[chosen], positive[chosen]


def sample_targets(
    truth: Tensor, moved: Tensor, target: Tensor, target_mask: Tensor, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Wrong targets of every point and their mask, (B, N, count): half of them uniform, the others near (spec 2.2).

    For an inlier a third is near in space and the rest near in index, never the true one or, as annotators err by one, its
    neighbour. For an outlier they are the nearest in space.
    """
    B, N = truth.shape
    M = target.shape[1]
    near_index = max(1, count // 5) if count > 1 else 0
    near_space = round(0.3 * count)
    uniform = count - near_index - near_space

    def draw(high: int, many: int) -> Tensor:
        return torch.randint(high, (B, N, many), generator=generator).to(truth.device)

    length = target_mask.sum(-1)[:, None, None]
    anywhere = draw(M, uniform) % length.clamp(min=1)
    near = near_space + near_index
    most = min(max(NEAREST, near), M)
    nearest = squared_distances(moved, target, target_mask).topk(most, largest=False).indices  # (B, N, 15) or more
    close = nearest.gather(-1, draw(min(NEAREST, M), near_space))
    step = (2 + draw(9, near_index)) * (1 - 2 * draw(2, near_index))
    beside = truth.clamp(min=0)[..., None] + step
    of_inlier, of_outlier = torch.cat([close, beside], dim=-1), torch.nn.functional.pad(nearest, (0, near - most), value=M)
    is_outlier = (truth < 0)[..., None]
    index = torch.cat([anywhere, torch.where(is_outlier, of_outlier, of_inlier)], dim=-1)
    inside = (index >= 0) & (index < length)
    wrong = (index - truth[..., None]).abs() > 1
    return index.clamp(0, M - 1), inside & (wrong | is_outlier)


def outlier_examples(
    view: PairView, plugins: PlugIns, scales: Scales, data_booster: StumpEnsemble, inference: InferenceConfig
) -> tuple[Tensor, Tensor]:
    """Source points: (P, 14) inputs reduced over the candidates of inference, and (P,) whether the point is a true outlier."""
    batch = view.batch
    assert batch.truth is not None
    found = find_candidates(view, plugins.motions, plugins.active, inference)
    boosters = Boosters(data_booster.thresholds.shape[1])
    boosters.data = data_booster
    states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
    registered = association.registered_feature(own_motion(plugins, batch.source), batch.target, found.index, scales)[..., None]
    local = torch.cat([states.static, registered], dim=-1)
    margin = states.static_margin + data_booster.margins(registered, first=STATIC_CHANNELS)
    inputs = association.outlier_inputs(local, margin, found.index, found.mask)
    known = batch.truth.known & batch.source_mask & plugins.known
    return inputs[known], (batch.truth.association < 0)[known]


def fit_boosters(
    views: Sequence[PairView],
    plugins: Sequence[PlugIns],
    scales: Scales,
    *,
    stumps: int,
    negatives: int,
    inference: InferenceConfig,
    most: int,
    hidden: Sequence[int],
    generator: torch.Generator,
) -> Boosters:
    """Data booster, then the outlier booster on its margins.

    Args:
        most: maximum number of examples of each, 0: all.
        hidden: local channels excluded from both.
    """
    boosters = Boosters(stumps)
    both = list(zip(views, plugins, strict=True))
    pairs = [data_examples(view, plugin, scales, negatives, generator) for view, plugin in both]
    boosters.data = fit_stumps(*_stack(pairs, most, hidden, generator), stumps)
    points = [outlier_examples(view, plugin, scales, boosters.data, inference) for view, plugin in both]
    boosters.outlier = fit_stumps(*_stack(points, most, hidden, generator), stumps)
    assert len(boosters.data.thresholds) == len(LOCAL_CHANNELS)
    assert len(boosters.outlier.thresholds) == OUTLIER_INPUTS
    return boosters


def _stack(
    parts: Sequence[tuple[Tensor, Tensor]], most: int, hidden: Sequence[int], generator: torch.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and classes of all parts, subsampled to `most` (0: all); hidden channels are constant, so never split on."""
    inputs, positive = torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])
    if 0 < most < len(inputs):
        kept = torch.randperm(len(inputs), generator=generator)[:most].to(inputs.device)
        inputs, positive = inputs[kept], positive[kept]
    inputs[:, list(hidden)] = 0.0
    return inputs.float().cpu().numpy(), positive.cpu().numpy()
