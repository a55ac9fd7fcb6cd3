"""Uncertainty of predictions: covariances of the motions, unobserved directions, and calibrated confidences.

A motion's errors come from more than the sensor's noise: returns sample a surface, surfaces bend, neighbouring beams share a jolt,
and the fit stops early. So the covariance uses the larger of residuals and sensor noise, and is that of a sum of correlated
scores (a sandwich estimator). Noise in the directions of surfaces must not count as information: along a corridor every noisy
tangent seems to constrain the motion. Tangents are therefore estimated anew, from stretches long compared with the noise.

Scans that are skewed, by turning while they are swept, fit none the better for more points: what noise and sampling do not explain
of the residuals tells how much, and is an error of the motion as a whole.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from torchcrf_scan.choices import MOTION_METRICS
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.directions import is_straight, spacing_of, surface_runs, surface_tangents, usual_turn
from torchcrf_scan.inference.motion import Support
from torchcrf_scan.prediction import LEAST_SHARE, Uncertainty

RUN = 48  # neighbouring points with possibly correlated errors: a jolt lasts several degrees
NOTHING = 1e-3  # of a point's information, so that no matrix is singular
TINY = 1e-6  # of the scene's extent: the least noise
EMPTY = 1000.0  # noises: the extent of a scene without points, some ten metres
SHARED = 3.0  # factor on the residual that noise and sampling do not explain, in an error that all points share,
BENT = 0.05  # of the spacing: distance of a surface from the straight line between two returns, as sampling explains it
COARSE = math.radians(4.0)  # between beams: neighbours do not sample a surface, and all of the residual is shared, with factor 1
MOST_CERTAIN = -50.0  # log-beliefs below this are treated as impossible
WITHIN = 2  # target points; nearer associations count as equal, since annotations err by one themselves


def motion_covariance(
    source: Tensor, support: Support, motions: Tensor, *, metric: str, scale: Tensor, noise: Tensor
) -> Uncertainty:
    """Covariance of the motions fitted by `motion.estimate`, and their unobserved directions.

    With the score g_i = w_i J_i^T M_i r_i of every point and H = sum_i w_i J_i^T M_i J_i, it is H^-1 K H^-1 where K sums

        v sum_i w_i^2 J_i^T M_i J_i                          independent errors, v the larger of two returns' noise and residuals
        1 / RUN sum over runs of points of (sum g) (sum g)^T     errors shared by neighbours
        (sum_i g_i) (sum_i g_i)^T                            the remaining step: the fit stopped before convergence.

    To it comes the error that all points share (`shared_error`), alike in all directions. Independent errors are counted up to
    twice, and errors hidden by the choice of partners are not counted: `Calibration.covariance_factor` corrects for both. A
    direction with less information than `LEAST_SHARE` has only a prior: no point moves farther than the scene's extent, and a
    rotation is arbitrary. Differentiable at a fixed set of these directions. O(B C N).

    Args:
        source: (B, N, 2) in beam order, N >= 1. support: of the last fit. motions: (B, C, 3) its result.
        metric: `point`, else point-to-line: only distances across the surface constrain a motion.
        scale: () or (B,) residual at which a robust weight is one half. noise: (B,) standard deviation of a range.
            Both in the unit of the points.
    """
    reach = torch.linalg.vector_norm(source, dim=-1).detach().amax(-1)  # (B,)
    reach = torch.where(reach > 0, reach, EMPTY * noise).clamp(min=1e-3)
    noise = noise.maximum(TINY * reach)
    at = Linearisation.of(source, support, motions, metric, scale, noise)
    total = at.weights.sum(-1).clamp(min=1e-9)  # (B, C)
    score = (at.jacobian * (at.weights[..., None] * at.residual)[..., None]).sum(-2)  # (B, C, N, 3)
    step = score.sum(-2)
    spread = (at.weights * (at.residual**2).sum(-1)).sum(-1) / (at.weights * at.freedom).sum(-1).clamp(min=1e-9)
    variance = torch.maximum(2 * noise[:, None] ** 2, spread)[..., None, None].double()  # (B, C, 1, 1)
    apart = torch.einsum("bcn,bcnia,bcnid->bcad", at.weights**2, at.jacobian, at.jacobian).double()
    together = shared_scores(score) + step[..., :, None] * step[..., None, :]
    identity = torch.eye(3, dtype=torch.float64, device=source.device)
    meat = variance * (apart + NOTHING * identity) + together

    normal = torch.einsum("bcn,bcnia,bcnid->bcad", at.weights, at.jacobian, at.jacobian).double() / total[..., None, None]
    information, vectors = torch.linalg.eigh(normal.detach())
    seen = vectors * (information >= LEAST_SHARE)[..., None, :]
    keep = seen @ vectors.mT  # projection onto the observed directions
    pretended = (
        LEAST_SHARE if MOTION_METRICS[metric].along_surface else 0.0
    )  # by the residual noise of the tangents, and by steps along the surface
    bread = keep @ (normal - pretended * identity) @ keep * total[..., None, None]
    length = at.length.double()
    prior = torch.stack([3 / (torch.pi * length) ** 2, *(1 / reach[:, None] ** 2).expand(2, *length.shape)], -1).diag_embed()
    local = torch.linalg.inv(bread @ torch.linalg.inv(meat) @ bread + prior)
    if MOTION_METRICS[metric].along_surface:
        local = local + shared_error(source, at, spread, noise)[..., None, None].double() * identity
    covariance = about_origin(local, length, (motions[..., 1:] - at.centre).double())
    return Uncertainty(covariance.to(source), information.to(source), vectors.mT.to(source))


def shared_error(source: Tensor, at: Linearisation, spread: Tensor, noise: Tensor) -> Tensor:
    """(B, C) squared error of the motions that all their points share: what noise and sampling do not explain of the residuals.

    A coarse scan's points are partners of their own beams' next readings, which hides a part of the motion.

    Args:
        source: (B, N, 2). spread: (B, C) mean squared residual. noise: (B,).
    """
    step, near = usual_turn(source.detach()), spacing_of(source.detach())  # (B, 1), (B, N)
    free = at.weights * at.freedom
    sampled = (free * near[:, None] ** 2).sum(-1) / free.sum(-1).clamp(min=1e-9)
    beyond = spread - noise[:, None] ** 2  # of a return
    return torch.where(step >= COARSE, beyond, SHARED**2 * (beyond - BENT**2 * sampled)).clamp(min=0)


@dataclass(frozen=True, slots=True)
class Linearisation:
    """The fit's residuals near the motions, as functions of (theta L, x, y).

    Attributes:
        weights: (B, C, N) of the points, robust if the fit's are.
        residual: (B, C, N, 2) the part of the distance to the partner that the metric uses, M r: across the surface, or all of it.
        jacobian: (B, C, N, 2, 3) its derivative, M J; M is a projection.
        freedom: (B, C, N) number of residual components, the trace of M.
        centre: (B, C, 2) centroid of the moved points. length: (B, C) L, at least the noise, as coincident points have no extent.
    """

    weights: Tensor
    residual: Tensor
    jacobian: Tensor
    freedom: Tensor
    centre: Tensor
    length: Tensor

    @classmethod
    def of(cls, source: Tensor, support: Support, motions: Tensor, metric: str, scale: Tensor, noise: Tensor) -> Linearisation:
        """Arguments as in `motion_covariance`."""
        moved = se2.apply(motions, source[:, None])  # (B, C, N, 2)
        residual = moved - support.partner[:, None]
        weights, along = support.weights, torch.zeros_like(moved)
        if MOTION_METRICS[metric].along_surface:
            squared_scale = (scale**2).expand(source.shape[0])[:, None, None]
            weights = weights / (1 + (residual**2).sum(-1) / squared_scale)
            along = moved_tangents(source, support, motions, noise)
        total = weights.sum(-1).clamp(min=1e-9)  # (B, C)
        centre = (weights[..., None] * moved).sum(-2) / total[..., None]
        arm = moved - centre[..., None, :]
        length = ((weights * (arm**2).sum(-1)).sum(-1) / total + noise[:, None] ** 2).sqrt()
        lever = torch.stack([-arm[..., 1], arm[..., 0]], -1) / length[..., None, None]
        shifts = torch.eye(2, dtype=moved.dtype, device=moved.device).expand(*moved.shape, 2)
        every = torch.cat([lever[..., None], shifts, residual[..., None]], -1)  # (B, C, N, 2, 4)
        across = every - along[..., None] * (along[..., None] * every).sum(-2, keepdim=True)
        freedom = 2 - (along**2).sum(-1)
        return cls(weights, across[..., 3], across[..., :3], freedom, centre, length)


def moved_tangents(source: Tensor, support: Support, motions: Tensor, noise: Tensor) -> Tensor:
    """(B, C, N, 2) direction of the surface under every motion; 0 for an isolated partner. Arguments as in `motion_covariance`.

    Far away, where a wall is seen at a grazing angle, its returns are isolated; in line with their neighbours they are no ends.
    """
    run = surface_runs(source.detach(), noise)
    tangent, is_found = surface_tangents(source, support.weights.sum(1) > 0, noise, run)
    turned = se2.rotate(motions[..., :1], tangent[:, None])
    given = support.tangent[:, None]
    is_surface = (given != 0).any(-1) | is_straight(source.detach(), run, noise)[:, None]  # (B, 1, N)
    return torch.where((is_found[:, None] & is_surface)[..., None], turned, given)


def about_origin(local: Tensor, length: Tensor, offset: Tensor) -> Tensor:
    """Covariance of (theta, tx, ty) from that of (theta L, x, y) about a centroid, where a rotation changes t as well.

    local: (..., 3, 3). length: (...,) L. offset: (..., 2) t minus the centroid.
    """
    one, zero = torch.ones_like(length), torch.zeros_like(length)
    turn = torch.stack([one, -offset[..., 1], offset[..., 0]], -1) / length[..., None]  # d (theta, t) / d (theta L)
    shifts = (torch.stack([zero, one, zero], -1), torch.stack([zero, zero, one], -1))
    change = torch.stack([turn, *shifts], -1)
    covariance = change @ local @ change.mT
    return (covariance + covariance.mT) / 2


def shared_scores(score: Tensor) -> Tensor:
    """(B, C, 3, 3) sum of the squared scores of runs of `RUN` points, averaged over all offsets of the runs.

    Padding and points of other clusters contribute 0. score: (B, C, N, 3), in beam order.
    """
    flat = score.flatten(0, 1).mT  # (B C, 3, N)
    padded = nn.functional.pad(flat, (RUN - 1, RUN - 1))
    runs = RUN * nn.functional.avg_pool1d(padded, RUN, stride=1)  # (B C, 3, N + RUN - 1)
    return (runs @ runs.mT / RUN).unflatten(0, score.shape[:2])


class Answers(Protocol):
    """Labels and beliefs from which confidences are computed: a `Prediction`, or a round's state."""

    @property
    def association(self) -> Tensor:
        """(B, N)."""

    @property
    def cluster(self) -> Tensor:
        """(B, N)."""

    @property
    def candidates(self) -> Tensor:
        """(B, N, K)."""

    @property
    def log_association(self) -> Tensor:
        """(B, N, K+1)."""

    @property
    def log_cluster(self) -> Tensor:
        """(B, N, D)."""


class Calibration(nn.Module):
    """Calibration of confidences and covariances, fitted by `learning.calibration_fit`.

    A confidence is sigmoid(slope * log-odds + offset) of the chosen label against the others: labels are unchanged.

    Attributes:
        association, cluster: (2,) slope and offset.
        covariance_factor: () of all motions' covariances.
    """

    association: Tensor
    cluster: Tensor
    covariance_factor: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("association", torch.tensor([1.0, 0.0]))
        self.register_buffer("cluster", torch.tensor([1.0, 0.0]))
        self.register_buffer("covariance_factor", torch.tensor(1.0))

    def forward(self, prediction: Answers) -> tuple[Tensor, Tensor]:
        """Calibrated confidences in [0, 1], (B, N) of associations and (B, N) of clusters.

        An association counts as right within `WITHIN` target points of the true one.
        """
        association = self.association.to(prediction.log_association)
        cluster = self.cluster.to(prediction.log_cluster)
        return (
            torch.sigmoid(association[0] * association_log_odds(prediction) + association[1]),
            torch.sigmoid(cluster[0] * cluster_log_odds(prediction) + cluster[1]),
        )


def association_log_odds(prediction: Answers) -> Tensor:
    """(B, N) log-odds that the association is right within `WITHIN` target points."""
    association = prediction.association[..., None]
    near = ((prediction.candidates - association).abs() <= WITHIN) & (association >= 0)  # (B, N, K)
    return log_odds(prediction.log_association, torch.cat([near, association < 0], -1))


def cluster_log_odds(prediction: Answers) -> Tensor:
    """(B, N) log-odds of the chosen cluster."""
    states = prediction.log_cluster.shape[-1]
    state = torch.where(prediction.cluster >= 0, prediction.cluster, states - 1)
    return log_odds(prediction.log_cluster, state[..., None] == torch.arange(states, device=state.device))


def log_odds(log_beliefs: Tensor, chosen: Tensor) -> Tensor:
    """Log-odds of the chosen states against the others, finite. log_beliefs, chosen: (..., S). Returns (...,)."""
    log_beliefs = log_beliefs.clamp(min=MOST_CERTAIN)
    yes = log_beliefs.masked_fill(~chosen, 2 * MOST_CERTAIN).logsumexp(-1)
    return yes - log_beliefs.masked_fill(chosen, 2 * MOST_CERTAIN).logsumexp(-1)
