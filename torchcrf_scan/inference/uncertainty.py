"""Uncertainty of predictions: covariances of the motions, unobserved directions, and calibrated confidences.

A motion's errors come from more than the sensor's noise: returns sample a surface, surfaces bend, neighbouring beams share a jolt,
and the fit stops early. So the covariance uses residuals and sensor noise, and is that of a sum of correlated scores (a sandwich
estimator). Where a few points alone hold a direction the fit follows their errors and leaves no residual: every run of points is
judged by the fit without it, a jackknife (CR3 of Cameron and Miller, "A practitioner's guide to cluster-robust inference", 2015).
Noise in the directions of surfaces must not count as information: along a corridor every noisy tangent seems to constrain the
motion. Tangents are therefore estimated anew, from stretches long compared with the noise.

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

RUNS = 6  # a cluster consists of so many runs of neighbouring points whose errors may be correlated
RIDGE = 0.01  # of all information: what a motion is known without a run that alone holds one of its directions
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

    With the score g_i = w_i J_i^T M_i r_i of every point, H_i = w_i J_i^T M_i J_i and H their sum, it is H^-1 K H^-1 where K sums

        1 / R sum over runs of A (sum g) (sum g)^T A^T     errors shared by neighbours; a run has R points, one in `RUNS`
        1 / R sum over runs of A v (sum w H) A^T           independent errors, v the squared noise of a return
        (sum_i g_i) (sum_i g_i)^T                          the remaining step: the fit stopped before convergence.

    A = H (H - sum H)^-1 turns the score of a run under this fit into that under the fit to all others (`left_out`).

    To it comes the error that all points share (`shared_error`), alike in all directions. Independent errors are counted one and
    a half times, and more where few runs hold a direction; errors hidden by the choice of partners are not counted:
    `Calibration.covariance_factor` corrects for both. A direction with less information than `LEAST_SHARE` has only a prior: no
    point moves farther than the scene's extent, and a rotation is arbitrary. Differentiable at a fixed set of these directions.
    O(B C N).

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
    score = (at.jacobian * (at.weights[..., None] * at.residual)[..., None]).sum(-2).double()  # (B, C, N, 3)
    each = torch.einsum("bcn,bcnia,bcnid->bcnad", at.weights, at.jacobian, at.jacobian).double()  # (B, C, N, 3, 3)
    step, normal = score.sum(-2), each.sum(-3)
    spread = (at.weights * (at.residual**2).sum(-1)).sum(-1) / (at.weights * at.freedom).sum(-1).clamp(min=1e-9)
    identity = torch.eye(3, dtype=torch.float64, device=source.device)
    variance = (noise.double() ** 2)[:, None]  # (B, 1) of a return
    length = ((support.weights > 0).sum(-1) + RUNS - 1) // RUNS  # (B, C) points in a run
    together, apart = left_out(score, each, at.weights.double(), length)
    nothing = NOTHING * torch.maximum(variance, spread.double())[..., None, None] * identity
    meat = together + variance[..., None, None] * apart + nothing + step[..., :, None] * step[..., None, :]

    normal = normal / total[..., None, None]
    information, vectors = torch.linalg.eigh(normal.detach())
    seen = vectors * (information >= LEAST_SHARE)[..., None, :]
    keep = seen @ vectors.mT  # projection onto the observed directions
    along_surface = MOTION_METRICS[metric].along_surface
    pretended = LEAST_SHARE if along_surface else 0.0  # by the tangents' noise, and by steps along the surface
    bread = keep @ (normal - pretended * identity) @ keep * total[..., None, None]
    extent = at.length.double()
    prior = torch.stack([3 / (torch.pi * extent) ** 2, *(1 / reach[:, None] ** 2).expand(2, *extent.shape)], -1).diag_embed()
    local = torch.linalg.inv(bread @ torch.linalg.inv(meat) @ bread + prior)
    if along_surface:
        local = local + shared_error(source, at, spread, noise)[..., None, None].double() * identity
    covariance = about_origin(local, extent, (motions[..., 1:] - at.centre).double())
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


def left_out(score: Tensor, each: Tensor, weights: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Sums over runs, averaged over all offsets: of squared scores, and of independent errors of unit variance; (B, C, 3, 3).

    Both are those of the fit without the run (`motion_covariance`), which knows `RIDGE` of all information of directions that the
    run alone holds. Padding and points of other clusters contribute 0. O(B C N).

    Args:
        score: (B, C, N, 3), in beam order. each: (B, C, N, 3, 3) H_i. weights: (B, C, N). length: (B, C) points in a run.
    """
    N = score.shape[2]
    last = torch.arange(N + (N + RUNS - 1) // RUNS, device=score.device) + 1  # as many as a run of all points needs
    ends = last.clamp(max=N).expand(*length.shape, -1), (last - length[..., None]).clamp(0, N)  # (B, C, W)

    def run(values: Tensor) -> Tensor:
        total = nn.functional.pad(values.flatten(3).cumsum(2), (0, 0, 1, 0))  # (B, C, N+1, D)
        high, low = (total.gather(2, end[..., None].expand(*end.shape, total.shape[-1])) for end in ends)
        return (high - low).unflatten(3, values.shape[3:])

    ridge = RIDGE * weights.sum(-1).clamp(min=1e-9)[..., None, None] * torch.eye(3, dtype=each.dtype, device=each.device)
    whole = (each.sum(2) + ridge)[:, :, None]
    change = whole @ torch.linalg.inv(whole - run(each))  # (B, C, W, 3, 3)
    scores = (change @ run(score)[..., None]).squeeze(-1)
    apart = change @ run(weights[..., None, None] * each) @ change.mT
    share = 1 / length.clamp(min=1)[..., None, None]
    return share * (scores.mT @ scores), share * apart.sum(2)


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
