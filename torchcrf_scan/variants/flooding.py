"""Algorithm 1 as printed: node by node, the motions re-estimated after every visit (spec 7.2, `flooding`).

Slow and faithful. Visits run x_c_1..x_c_N, x_a_1..x_a_N, ascending or in alternating direction (A-20); each visit rebuilds the
node's local features from the present motions and plug-ins, sends its messages, updates its label and the running sums of
its clusters. The association candidates are chosen anew before every iteration and messages carried over by target point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.association import pairwise_features
from torchcrf_scan.features.candidates import Candidates
from torchcrf_scan.features.potentials import (
    AssociationStates,
    PairView,
    association_potentials,
    association_unary,
    clustering_potentials,
    clustering_unary,
    find_candidates,
    possible_clusters,
    registered_points,
    state_mask,
)
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.messages import normalise, reduce_states
from torchcrf_scan.inference.motion import RunningSums, retire_empty
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, State
from torchcrf_scan.names import ASSOCIATION_UNARY
from torchcrf_scan.prediction import Prediction

MESSAGE_TOLERANCE = 1e-3


@dataclass(slots=True)
class Messages:
    """Messages into every node of a chain: from the node before it and from the node after it, (B, N, S) each."""

    forward: Tensor
    backward: Tensor

    @classmethod
    def zeros(cls, B: int, N: int, S: int, like: Tensor) -> Messages:
        """Initial messages, all 0."""
        return cls(like.new_zeros(B, N, S), like.new_zeros(B, N, S))


@torch.no_grad()
def decode(view: PairView, start: Start, parameters: Parameters, model: ModelConfig) -> Prediction:
    """Labels and motions of a batch; no gradient. Arguments as in `joint.decode`."""
    run = Flooding(view, start, parameters, model)
    converged = torch.zeros(len(view.batch), dtype=torch.bool, device=view.batch.source.device)
    iterations = torch.zeros(len(view.batch), dtype=torch.int64, device=view.batch.source.device)
    for iteration in range(model.inference.iterations):
        before, said = run.state, run.said()
        run.iterate(descending=model.inference.flooding_order == "alternate" and iteration % 2 == 1)
        stop_early = model.inference.stop_early
        if stop_early:
            run.state = joint.keep_settled(run.state, before, converged)
        iterations = iterations + (~converged | (not stop_early)).long()
        converged = converged | (joint.has_settled(run.state, before, model.inference) & run.agrees_with(said))
        if stop_early and bool(converged.all()):
            break
    merged = joint.merge_alike(view, run.state, parameters.scales.cluster_distance)
    return joint.read_out(view.batch, start, merged, parameters, model.inference, converged, iterations)


class Flooding:
    """Working state of one run: labels and motions, messages of both chains, running sums of every cluster."""

    def __init__(self, view: PairView, start: Start, parameters: Parameters, model: ModelConfig) -> None:
        self.view, self.start, self.parameters, self.model = view, start, parameters, model
        self.state = joint.first_state(view, start, parameters, model.inference)
        B, N = view.batch.source.shape[:2]
        self.cluster_messages = Messages.zeros(B, N, self.state.log_cluster.shape[-1], view.batch.source)
        self.association_messages = Messages.zeros(B, N, self.state.log_association.shape[-1], view.batch.source)

    @property
    def config(self) -> InferenceConfig:
        """The settings of inference."""
        return self.model.inference

    def iterate(self, descending: bool) -> None:
        """One visit to every node of every chain of the model."""
        batch = self.view.batch
        self.sums = self._running_sums()
        found = find_candidates(self.view, self.state.motions.value, self.state.motions.active, self.config)
        order = range(batch.source.shape[1] - 1, -1, -1) if descending else range(batch.source.shape[1])
        if self.model.has_clusters:
            for i in order:
                self.visit_cluster(i, found)
        if self.model.has_association:
            self._take_candidates(found)
            for i in order:
                self.visit_association(i)
        self._retire_empty()

    def said(self) -> list[Tensor]:
        """Copies of all messages."""
        both = (self.cluster_messages, self.association_messages)
        return [message.clone() for messages in both for message in (messages.forward, messages.backward)]

    def agrees_with(self, before: list[Tensor]) -> Tensor:
        """(B,) whether no message has changed by more than the tolerance (spec 7.6)."""
        steady = [
            ((new == old) | ((new - old).abs() < MESSAGE_TOLERANCE)).flatten(1).all(-1)
            for new, old in zip(self.said(), before, strict=True)
        ]
        return torch.stack(steady).all(0)

    def visit_cluster(self, i: int, found: Candidates) -> None:
        """Visits one node of the clustering chain: local features, messages to both neighbours, label, motions."""
        batch, state, scales = self.view.batch, self.state, self.parameters.scales
        here = slice(i, i + 1)
        around = slice(max(i - 1, 0), min(i + 2, batch.source.shape[1]))
        at = clustering.correspond(
            batch.source[:, around], batch.target, state.motions.value, found.nearest[:, around], state.association[:, around]
        )
        reach = None if self.start.reach is None else self.start.reach[:, around]
        local = clustering_unary(self.view, at, state.motions.value, state.motions.active, scales, reach)
        pairwise = clustering.pairwise_features(batch.source[:, around], at, scales)
        possible = possible_clusters(state.motions.active, self.view.within(reach), around.stop - around.start)
        unary, edges = clustering_potentials(local, pairwise, possible, self.parameters.clustering)
        k = i - around.start
        before = edges[:, k - 1] if k > 0 else None
        after = edges[:, k] if k < edges.shape[1] else None
        belief = self._send(self.cluster_messages, i, unary[:, k], before, after)
        log_cluster = state.log_cluster.clone()
        log_cluster[:, here] = self._normalised(belief)[:, None]
        cluster = state.cluster.clone()
        cluster[:, here] = joint.cluster_labels(belief[:, None].argmax(-1), belief.shape[-1] - 1, batch.source_mask[:, here])
        self._relabel(i, replace(state, log_cluster=log_cluster, cluster=cluster))

    def visit_association(self, i: int) -> None:
        """Visits one node of the association chain, likewise."""
        batch, state, scales, boosters = self.view.batch, self.state, self.parameters.scales, self.parameters.boosters
        here = slice(i, i + 1)
        motions, active = state.motions.value, state.motions.active
        moved = registered_points(batch.source[:, here], motions, active, state.log_cluster[:, here])
        states = self.states.nodes(here)
        features = association_unary(self.view, states, moved, scales, boosters)
        unary = features @ self.parameters.association[:ASSOCIATION_UNARY]
        unary = unary.masked_fill(~state_mask(states.mask), -torch.inf)[:, 0]
        before = self.edges[:, i - 1] if i > 0 else None
        after = self.edges[:, i] if i < self.edges.shape[1] else None
        belief = self._send(self.association_messages, i, unary, before, after)
        log_association = state.log_association.clone()
        log_association[:, here] = self._normalised(belief)[:, None]
        association = state.association.clone()
        association[:, here] = joint.association_labels(belief[:, None].argmax(-1), states.candidates, batch.source_mask[:, here])
        state = replace(state, log_association=log_association, association=association)
        if not self.model.has_clusters:
            state = joint.inliers_are_background(state)
        self._relabel(i, state)

    def _send(self, messages: Messages, i: int, unary: Tensor, before: Tensor | None, after: Tensor | None) -> Tensor:
        """Sends node i's messages to its neighbours; padding sends none. Returns its belief (B, S)."""
        mask = self.view.batch.source_mask
        temperature = self.config.temperature
        if after is not None:
            said = normalise(reduce_states((unary + messages.forward[:, i])[:, :, None] + after, 1, temperature))
            messages.forward[:, i + 1] = said.masked_fill(~mask[:, i, None], 0.0)
        if before is not None:
            said = normalise(reduce_states((unary + messages.backward[:, i])[:, None] + before, 2, temperature))
            messages.backward[:, i - 1] = said.masked_fill(~mask[:, i, None], 0.0)
        return unary + messages.forward[:, i] + messages.backward[:, i]

    def _normalised(self, belief: Tensor) -> Tensor:
        """Log-beliefs normalised as in `chain_beliefs`."""
        return torch.log_softmax(belief / self.config.temperature if self.config.temperature else belief, -1)

    def _relabel(self, i: int, state: State) -> None:
        """ComputeRT after node i changed its label or partner, in O(1) (spec 7.4)."""
        target, C = self.view.batch.target, state.motions.value.shape[1]

        def vote(of: State) -> tuple[Tensor, Tensor]:
            speaks = (of.association[:, i] >= 0) & (of.cluster[:, i] >= 0)
            one_hot = torch.nn.functional.one_hot(of.cluster[:, i].clamp(min=0), C).double() * speaks[:, None]
            return gather_points(target, of.association[:, i : i + 1].clamp(min=0))[:, 0], one_hot

        self.sums.change(self.view.batch.source[:, i], *vote(self.state), *vote(state))
        value = self.sums.motions(state.motions, self.config.min_extent)
        self.state = replace(state, motions=replace(state.motions, value=value))

    def _running_sums(self) -> RunningSums:
        batch, state = self.view.batch, self.state
        clusters = torch.arange(state.motions.value.shape[1], device=state.cluster.device)
        weights = (state.cluster[:, None] == clusters[:, None]) & (state.association >= 0)[:, None]
        return RunningSums.of(batch.source, gather_points(batch.target, state.association.clamp(min=0)), weights)

    def _take_candidates(self, found: Candidates) -> None:
        """Sets new inlier states of every node; messages follow their target points, a new state takes the smallest entry."""
        batch, scales = self.view.batch, self.parameters.scales
        old, old_mask = self.state.candidates, self.state.candidate_mask
        same = (found.index[..., :, None] == old[..., None, :]) & old_mask[..., None, :]  # (B, N, K new, K old)
        for name in ("forward", "backward"):
            message = getattr(self.association_messages, name)
            inliers = message[..., :-1]
            carried = torch.where(same, inliers[..., None, :], -torch.inf).amax(-1)
            least = inliers.masked_fill(~old_mask, torch.inf).amin(-1, keepdim=True)
            least = torch.where(least < torch.inf, least, 0.0)
            carried = torch.where(same.any(-1), carried, least)
            setattr(self.association_messages, name, torch.cat([carried, message[..., -1:]], dim=-1))
        self.states = AssociationStates.of(self.view, found.index, found.mask, scales, self.parameters.boosters)
        pairwise = pairwise_features(batch.source, batch.target, found.index, scales)
        none = pairwise.new_zeros(*found.index.shape, ASSOCIATION_UNARY)
        _, self.edges = association_potentials(
            torch.cat([none, none[:, :, :1]], dim=2), pairwise, found.mask, self.parameters.association
        )
        log = self.state.log_association
        self.state = replace(self.state, candidates=found.index, candidate_mask=found.mask, log_association=log)

    def _retire_empty(self) -> None:
        """Removes clusters without a point for two iterations (spec 7.5)."""
        self.state = replace(self.state, motions=retire_empty(self.state.motions, self.sums.value[..., 0].round()))
