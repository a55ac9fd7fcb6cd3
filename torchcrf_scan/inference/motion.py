"""ComputeRT: the motion of every cluster from the beliefs of both chains (Algorithm 1, lines 10 and 16; spec 7.4, 7.5)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch, safe_atan2

ALONG = 0.03  # weight of the residual along the surface in a point-to-line step
KEPT_SHARE, TRIM_ROUNDS = 0.8, 3  # of trimmed Kabsch
PATIENCE = 2  # rounds for which an empty cluster keeps its motion before it is removed


@dataclass(frozen=True, slots=True)
class Motions:
    """The continuous part of the state.

    Attributes:
        value: (B, C, 3) motions of background and movers.
        active: (B, C) bool, clusters that still exist; the background always does.
        empty_for: (B, C) int64 rounds without a point.
    """

    value: Tensor
    active: Tensor
    empty_for: Tensor

    @classmethod
    def start(cls, value: Tensor, active: Tensor) -> Motions:
        """value: (B, C, 3); active: (B, C)."""
        return cls(value, active, torch.zeros_like(active, dtype=torch.int64))


@dataclass(frozen=True, slots=True)
class Support:
    """Weighted correspondences from which the motion of every cluster is fitted.

    Attributes:
        weights: (B, C, N) non-negative.
        partner: (B, N, 2) associated target point.
        tangent: (B, N, 2) direction of the surface there.
        count: (B, C) number of points of the cluster (always by hard labels).
        spread: (B, C) largest extent of those points, metres (root mean square along their main axis).
    """

    weights: Tensor
    partner: Tensor
    tangent: Tensor
    count: Tensor
    spread: Tensor


def largest_spread(points: Tensor, weights: Tensor) -> Tensor:
    """sqrt of the largest eigenvalue of the weighted scatter matrix. points: (B, N, 2); weights: (B, C, N). Returns (B, C)."""
    total = weights.sum(-1).clamp(min=1)[..., None]
    mean = weights @ points / total  # (B, C, 2)
    second = weights @ torch.stack([points[..., 0] ** 2, points[..., 1] ** 2, points[..., 0] * points[..., 1]], -1) / total
    xx, yy = second[..., 0] - mean[..., 0] ** 2, second[..., 1] - mean[..., 1] ** 2
    xy = second[..., 2] - mean[..., 0] * mean[..., 1]
    largest = (xx + yy) / 2 + torch.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return largest.clamp(min=0).sqrt()


def hard_support(source: Tensor, target: Tensor, tangents: Tensor, association: Tensor, cluster: Tensor, clusters: int) -> Support:
    """Unit weights on the associated points of each cluster: the paper's Eq. 6.

    Args:
        source: (B, N, 2); target, tangents: (B, M, 2); association, cluster: (B, N), -1 outlier; clusters: C.
    """
    of_cluster = cluster[:, None] == torch.arange(clusters, device=cluster.device)[:, None]  # (B, C, N)
    weights = (of_cluster & (association >= 0)[:, None]).to(source.dtype)
    index = association.clamp(min=0)
    with torch.no_grad():
        spread = largest_spread(source, weights)
    return Support(weights, gather_points(target, index), gather_points(tangents, index), weights.sum(-1), spread)


def soft_support(
    source: Tensor,
    target: Tensor,
    tangents: Tensor,
    hard: Support,
    candidates: Tensor,
    log_association: Tensor,
    log_cluster: Tensor,
) -> Support:
    """Beliefs as weights and mean partners (A-18), so that gradients reach the feature weights.

    Args:
        hard: the support of the labels; degenerate clusters are decided by its counts.
        candidates: (B, N, K); log_association: (B, N, K+1); log_cluster: (B, N, D).
    """
    inlier = log_association[..., :-1].exp()  # (B, N, K)
    some = inlier.sum(-1, keepdim=True)
    share = inlier / some.clamp(min=1e-9)
    partner = (share[..., None] * gather_points(target, candidates)).sum(-2)
    tangent = gather_points(tangents, candidates.gather(-1, share.argmax(-1, keepdim=True)))[:, :, 0]
    real = hard.weights.new_ones(()) * (source.abs().sum(-1) > 0)
    weights = (log_cluster[..., :-1].exp() * (some * real[..., None])).transpose(1, 2)  # (B, C, N)
    return Support(weights, partner, tangent, hard.count, hard.spread)


def estimate(source: Tensor, support: Support, previous: Motions, *, metric: str, scale: Tensor, min_extent: float) -> Motions:
    """New motions from the supports, with the rules for small clusters (spec 7.5).

    Three or more points with some extent: a full fit. Fewer: the background's rotation, the points' translation. None: the
    motion is kept, for two rounds (`retire_empty`). The background with fewer than three points keeps its motion.

    Args:
        source: (B, N, 2). metric: one of `FITS`.
        scale: () residual at which a robust weight is one half, metres. min_extent: metres.
    """
    points = source[:, None].expand(-1, support.weights.shape[1], -1, -1)  # (B, C, N, 2)
    partner = support.partner[:, None].expand_as(points)
    fitted = FITS[metric](points, partner, support, previous.value, scale)
    total = support.weights.sum(-1, keepdim=True)  # (B, C, 1)
    share = support.weights / total.clamp(min=1e-9)
    large = (support.count >= 3) & (support.spread >= min_extent)
    background = torch.where(large[:, :1, None], fitted[:, :1], previous.value[:, :1])
    theta = background[..., :1].expand_as(fitted[..., :1])
    shift = (share[..., None] * (partner - se2.rotate(theta, points))).sum(-2)
    small_fit = torch.cat([theta, shift], dim=-1)
    value = torch.where(large[..., None], fitted, torch.where((support.count > 0)[..., None], small_fit, previous.value))
    value = torch.cat([background, value[:, 1:]], dim=1)
    return replace(previous, value=torch.where(previous.active[..., None], value, previous.value))


def trim(source: Tensor, support: Support) -> Support:
    """Keeps the best four fifths of every cluster's points under their own fit, three rounds (trimmed Kabsch, spec 7.3, 9.2).

    source: (B, N, 2).
    """
    points = source[:, None].expand(-1, support.weights.shape[1], -1, -1)  # (B, C, N, 2)
    partner = support.partner[:, None].expand_as(points)
    real = support.weights > 0
    most = (KEPT_SHARE * real.sum(-1, keepdim=True)).ceil().long().clamp(min=1) - 1  # (B, C, 1)
    weights = support.weights
    for _ in range(TRIM_ROUNDS):
        moved = se2.apply(kabsch(points, partner, weights), points)
        residual = torch.linalg.vector_norm(moved - partner, dim=-1).masked_fill(~real, torch.inf)
        weights = support.weights * (residual <= residual.sort(-1).values.gather(-1, most))
    return replace(support, weights=weights)


def retire_empty(motions: Motions, count: Tensor) -> Motions:
    """Ends a round: removes clusters (never the background) that had no point for two rounds. count: (B, C) points."""
    empty_for = torch.where(count > 0, 0, motions.empty_for + 1)
    active = motions.active & (empty_for < PATIENCE)
    active = torch.cat([torch.ones_like(active[:, :1]), active[:, 1:]], dim=1)
    return Motions(motions.value, active, empty_for)


def point_fit(points: Tensor, partner: Tensor, support: Support, start: Tensor, scale: Tensor) -> Tensor:
    """Closed-form Kabsch (Eq. 6), independent of the start. Arguments as in `line_fit`."""
    return kabsch(points, partner, support.weights)


def line_fit(points: Tensor, partner: Tensor, support: Support, start: Tensor, scale: Tensor) -> Tensor:
    """One robust point-to-line step from `start`. points, partner: (B, C, N, 2); start: (B, C, 3). Returns (B, C, 3)."""
    moved = se2.apply(start, points)
    tangent = support.tangent[:, None].expand_as(points)
    distance = moved - partner
    robust = support.weights / (1 + (distance**2).sum(-1) / scale**2)
    return se2.compose(gauss_newton_step(moved, partner, tangent, robust, ALONG), start)


FITS = {"point": point_fit, "line": line_fit}  # by the name of the metric, `choices.MOTION_METRICS`


@dataclass(slots=True)
class RunningSums:
    """Sums from which Eq. 6 follows in O(1) when one label changes (spec 7.4); float64, per cluster.

    Attributes:
        value: (B, C, 10): weight, p (2), q (2), p.q, p x q, p_x^2, p_y^2, p_x p_y.
    """

    value: Tensor

    @staticmethod
    def terms(p: Tensor, q: Tensor) -> Tensor:
        """(..., 10) contribution of a pair of points (..., 2)."""
        p, q = p.double(), q.double()
        one = torch.ones_like(p[..., :1])
        dot = (p * q).sum(-1, keepdim=True)
        cross = p[..., :1] * q[..., 1:] - p[..., 1:] * q[..., :1]
        return torch.cat([one, p, q, dot, cross, p**2, p[..., :1] * p[..., 1:]], dim=-1)

    @classmethod
    def of(cls, p: Tensor, q: Tensor, weights: Tensor) -> RunningSums:
        """p, q: (B, N, 2); weights: (B, C, N)."""
        return cls(weights.double() @ cls.terms(p, q))

    def change(self, p: Tensor, old_q: Tensor, old: Tensor, new_q: Tensor, new: Tensor) -> None:
        """Updates the sums when one point per pair changes label or partner. p, old_q, new_q: (B, 2); old, new: (B, C) weights."""
        self.value = self.value - old[..., None] * self.terms(p, old_q)[:, None] + new[..., None] * self.terms(p, new_q)[:, None]

    def motions(self, previous: Motions, min_extent: float) -> Tensor:
        """(B, C, 3) motions with the rules of spec 7.5, without removing clusters."""
        count = self.value[..., 0].round()
        total = count.clamp(min=1)[..., None]
        p, q = self.value[..., 1:3] / total, self.value[..., 3:5] / total
        dot = self.value[..., 5] / total[..., 0] - (p * q).sum(-1)
        cross = self.value[..., 6] / total[..., 0] - (p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0])
        xx, yy = (self.value[..., 7:9] / total - p**2).unbind(-1)
        xy = self.value[..., 9] / total[..., 0] - p[..., 0] * p[..., 1]
        spread = ((xx + yy) / 2 + torch.sqrt(((xx - yy) / 2) ** 2 + xy**2)).clamp(min=0).sqrt()
        before = previous.value.double()
        large = (count >= 3) & (spread >= min_extent)
        theta = safe_atan2(cross, dot)
        background = torch.where(large[:, :1], theta[:, :1], before[:, :1, 0])
        theta = torch.where(large, theta, background)
        shift = q - se2.rotate(theta, p)
        fitted = torch.cat([theta[..., None], shift], dim=-1)
        usable = (count > 0) & previous.active
        usable = torch.cat([large[:, :1], usable[:, 1:]], dim=1)
        return torch.where(usable[..., None], fitted, before).to(previous.value.dtype)


TURN_DAMPING, SHIFT_DAMPING = 1e-4, 1e-3  # relative to the weighted lever and to the weight

LEAST_DAMPING = 1e-6  # of a rotation about a single point, which has no lever

LARGEST_TURN = 0.5  # radians per step


def gauss_newton_step(moved: Tensor, partner: Tensor, tangent: Tensor, weights: Tensor, along: float) -> Tensor:
    """One least-squares step of a rigid motion, applied after the present one.

    Minimises sum_i w_i (r^T (I - (1 - along) t t^T) r): point-to-point at along = 1, point-to-line at 0.

    Args:
        moved, partner, tangent: (..., P, 2); weights: (..., P).

    Returns:
        (..., 3); the identity where all weights are 0. Damped, so finite for any number of points.
    """
    residual = moved - partner
    centre = (weights[..., None] * moved).sum(-2, keepdim=True) / weights.sum(-1)[..., None, None].clamp(min=1e-9)
    arm = moved - centre
    lever = torch.stack([-arm[..., 1], arm[..., 0]], dim=-1)  # d moved / d theta, rotation about the weighted centre
    slack = 1 - along

    def dot_metric(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum(-1) - slack * (a * tangent).sum(-1) * (b * tangent).sum(-1)

    axes = torch.eye(2, dtype=moved.dtype, device=moved.device)
    basis = (lever, axes[0].expand_as(lever), axes[1].expand_as(lever))
    total = weights.sum(-1).clamp(min=1e-9)
    normal = torch.stack([torch.stack([(weights * dot_metric(a, b)).sum(-1) for b in basis], -1) for a in basis], -2)
    right = torch.stack([-(weights * dot_metric(a, residual)).sum(-1) for a in basis], -1)
    scale = (weights * (lever**2).sum(-1)).sum(-1)
    damping = torch.stack([TURN_DAMPING * scale + LEAST_DAMPING * total, SHIFT_DAMPING * total, SHIFT_DAMPING * total], dim=-1)
    step, _ = torch.linalg.solve_ex(normal + torch.diag_embed(damping), right)  # damped, so always solvable
    theta, shift = step[..., 0].clamp(-LARGEST_TURN, LARGEST_TURN), step[..., 1:]
    pivot = centre[..., 0, :]
    return torch.cat([theta[..., None], pivot - se2.rotate(theta, pivot) + shift], dim=-1)
